"""Parametric families of objects with ground truth.

Modules:
    bottle: bottles
    bowl: bowls
    container: bins and shelves to stand bottles in
    convex: convex parts of generated objects for physics engines
    frusta: convex parts of solid bodies
    mug: mugs
    rack: racks to hang mugs on
    sectors: convex parts of walls around hollows
    shape: base class of generated objects
    solid: parts of solids, their meshes and exact inside tests
    stacks: rings along an axis, and where convex parts cut them
"""

from collections.abc import Callable
from typing import NamedTuple

from tdf_jax.shapes.bottle import Bottle, BottleParameters, build_bottle, sample_bottle
from tdf_jax.shapes.bowl import Bowl, BowlParameters, build_bowl, sample_bowl
from tdf_jax.shapes.container import Container, ContainerParameters, build_container, sample_container
from tdf_jax.shapes.mug import HANDLE_STYLES, Mug, MugParameters, build_mug, sample_mug
from tdf_jax.shapes.rack import Rack, RackParameters, build_rack, sample_rack
from tdf_jax.shapes.shape import Shape, scaled


class Family(NamedTuple):
    """A category of generated objects.

    Attributes:
        build: makes a `Shape` of its parameters.
        sample: draws parameters with a numpy generator.
        places: names of the frames of every object; demonstrations pick the first place.
        size: size of a common object, metres: the height of a mug, the diagonal of others.
    """

    build: Callable
    sample: Callable
    places: tuple[str, ...]
    size: float


FAMILIES = {
    "mug": Family(build_mug, sample_mug, ("handle", "rim", "base"), 0.12),
    "bowl": Family(build_bowl, sample_bowl, ("rim", "base", "body"), 0.20),
    "bottle": Family(build_bottle, sample_bottle, ("neck", "base", "body"), 0.22),
    "rack": Family(build_rack, sample_rack, ("peg", "post", "base"), 0.38),
    "container": Family(build_container, sample_container, ("floor", "opening", "base"), 0.28),
}

__all__ = [
    "FAMILIES",
    "HANDLE_STYLES",
    "Bottle",
    "BottleParameters",
    "Bowl",
    "BowlParameters",
    "Container",
    "ContainerParameters",
    "Family",
    "Mug",
    "MugParameters",
    "Rack",
    "RackParameters",
    "Shape",
    "build_bottle",
    "build_bowl",
    "build_container",
    "build_mug",
    "build_rack",
    "sample_bottle",
    "sample_bowl",
    "sample_container",
    "sample_mug",
    "sample_rack",
    "scaled",
]
