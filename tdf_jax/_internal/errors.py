"""The one exception a user's mistake raises, so the command line can tell it from a bug; and what is only doubted."""


class InputError(ValueError):
    """Raised at the public edge: the message names the function, what it got, what it expected and the fix."""


class CategoryWarning(UserWarning):
    """Issued where an object does not look like one of the category that a network and a demonstration are for."""
