"""The exception that a user's mistake raises, so that the command line can tell it from a bug, and warnings."""


class InputError(ValueError):
    """Raised for a user's mistake: the message names the function, what it got, what it expected and the fix."""


class TdfWarning(UserWarning):
    """Base class of the warnings of tdf_jax; `tdf` prints them as lines of their own."""


class CategoryWarning(TdfWarning):
    """Issued if an object is probably not of the category of the network and the demonstration."""


class ConfidenceWarning(TdfWarning):
    """Issued if a pick is probably wrong."""


class ForeignPointsWarning(TdfWarning):
    """Issued if points are removed as foreign, or too many look it, or an object lies on its target's surface."""


class SizeWarning(TdfWarning):
    """Issued if an object is far smaller or larger than those that the network was trained on."""


class InvalidPointsWarning(TdfWarning):
    """Issued if points are removed because they are no measurements."""
