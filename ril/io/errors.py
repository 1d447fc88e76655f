"""Errors that a user can correct; commands print them as one line without a traceback."""

import hashlib

_LONGEST = 1000  # characters of `printable`


def one_line(value: object) -> str:
    """Return the text of an error or a value without its line breaks."""
    return " ".join(str(value).split())


def printable(text: str) -> str:
    """Return a text as a row can hold it: in one line, and of a thousand characters at most.

    Characters that cannot be printed are escaped. The end of a longer text is replaced by a hash
    of the whole, so that different long texts stay different.
    """
    line = "".join(
        each if each.isprintable() else each.encode("unicode_escape").decode() for each in text
    )
    if len(line) <= _LONGEST:
        return line
    return f"{line[: _LONGEST - 11]}…{hashlib.sha256(line.encode()).hexdigest()[:10]}"


class UserError(Exception):
    """A value or a file from the user cannot be used.

    The message names the key and its value, or the file, and says what is allowed.
    """


class NotFiniteError(UserError):
    """A number of a run is not finite, so that its results would mean nothing.

    The message says where: an observation, a reward, a loss or a parameter.
    """
