"""Mistakes of the user, which end in one line instead of a traceback."""


def one_line(said: object) -> str:
    """What an error or a value says, without its line breaks."""
    return " ".join(str(said).split())


class UserError(Exception):
    """Something the user gave cannot be used; the message names the key, the value, what may be."""
