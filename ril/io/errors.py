"""Errors that a user can correct; commands print them as one line without a traceback."""


def one_line(value: object) -> str:
    """Return the text of an error or a value without its line breaks."""
    return " ".join(str(value).split())


class UserError(Exception):
    """A value or a file from the user cannot be used.

    The message names the key and its value, or the file, and says what is allowed.
    """


class NotFiniteError(UserError):
    """A number of a run is not finite, so that its results would mean nothing.

    The message says where: an observation, a reward, a loss or a parameter.
    """
