"""The exception that a user's mistake raises, so that the command line can tell it from a bug, and warnings."""


class InputError(ValueError):
    """Raised for a user's mistake: the message names the function, what it got, what it expected and the fix."""


class CategoryWarning(UserWarning):
    """Issued if an object is probably not of the category of the network and the demonstration."""
