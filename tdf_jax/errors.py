"""The one exception a user's mistake raises, so the command line can tell it from a bug."""


class InputError(ValueError):
    """Raised at the public edge: the message names the function, what it got, what it expected and the fix."""
