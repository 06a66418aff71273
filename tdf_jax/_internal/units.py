"""Units of length."""

from typing import NamedTuple


class Unit(NamedTuple):
    """A unit of length.

    Attributes:
        name: its name in messages, in the plural.
        metres: metres per unit.
        spellings: what names of columns call it, in lower case.
    """

    name: str
    metres: float
    spellings: tuple[str, ...]


METRES = Unit("metres", 1.0, ("m", "metre", "metres", "meter", "meters"))
CENTIMETRES = Unit("centimetres", 0.01, ("cm", "centimetres", "centimeters"))
MILLIMETRES = Unit("millimetres", 0.001, ("mm", "millimetres", "millimeters"))
INCHES = Unit("inches", 0.0254, ("in", "inch", "inches"))
UNITS = (
    METRES,
    CENTIMETRES,
    MILLIMETRES,
    INCHES,
    Unit("decimetres", 0.1, ("dm",)),
    Unit("kilometres", 1000.0, ("km",)),
    Unit("micrometres", 1e-6, ("um",)),
    Unit("feet", 0.3048, ("ft",)),
)
