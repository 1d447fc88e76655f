"""Mistakes of the user, which end in one line instead of a traceback."""


class UserError(Exception):
    """Something the user gave cannot be used; the message names the key, the value, what may be."""
