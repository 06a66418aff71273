"""Parametric object families with ground truth.

Modules:
    bottle: bottles
    bowl: bowls
    mug: mugs
    shape: what all generated objects share
    solid: solids of stacked polygons, their meshes and exact inside tests
"""

from collections.abc import Callable
from typing import NamedTuple

from tdf_jax.shapes.bottle import Bottle, BottleParameters, build_bottle, sample_bottle
from tdf_jax.shapes.bowl import Bowl, BowlParameters, build_bowl, sample_bowl
from tdf_jax.shapes.mug import HANDLE_STYLES, Mug, MugParameters, build_mug, sample_mug
from tdf_jax.shapes.shape import Shape, scaled


class Family(NamedTuple):
    """A category of generated objects.

    Attributes:
        build: parameters -> `Shape`.
        sample: a numpy generator -> parameters.
        places: names of the frames every object of it has; the first is where demonstrations pick it.
        size: of a common one, metres: a mug's height, the diagonal of others.
    """

    build: Callable
    sample: Callable
    places: tuple[str, ...]
    size: float


FAMILIES = {
    "mug": Family(build_mug, sample_mug, ("handle", "rim", "base"), 0.12),
    "bowl": Family(build_bowl, sample_bowl, ("rim", "base", "body"), 0.20),
    "bottle": Family(build_bottle, sample_bottle, ("neck", "base", "body"), 0.22),
}

__all__ = [
    "FAMILIES",
    "HANDLE_STYLES",
    "Bottle",
    "BottleParameters",
    "Bowl",
    "BowlParameters",
    "Family",
    "Mug",
    "MugParameters",
    "Shape",
    "build_bottle",
    "build_bowl",
    "build_mug",
    "sample_bottle",
    "sample_bowl",
    "sample_mug",
    "scaled",
]
