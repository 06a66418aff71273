"""Base class of generated objects: a mesh with ground truth, an exact inside test, frames of places, a symmetry."""

import dataclasses
from abc import ABC, abstractmethod
from collections.abc import Callable, Collection, Mapping
from functools import cached_property
from typing import TYPE_CHECKING, Any, ClassVar, NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from tdf_jax._internal import checks
from tdf_jax._internal.deprecation import warn
from tdf_jax._internal.errors import InputError
from tdf_jax.shapes.solid import Part, closed_mesh, encloses, rings

if TYPE_CHECKING:
    import trimesh


class Solid(NamedTuple):
    """A union of parts, minus hollows that are cut out of it afterwards."""

    parts: tuple[Part, ...]
    hollows: tuple[Part, ...]


@dataclasses.dataclass(frozen=True, eq=False)
class Shape(ABC):
    """A generated object. Its canonical frame has z up along its axis and its origin there, at half the body's height.

    Attributes:
        mesh: watertight mesh of the material, metres, with outward normals; cavities are open.
        parameters: dimensions of the object; lengths in metres.
        frames: poses T_object_frame of its semantic places by name, (4, 4), metres.
    """

    category: ClassVar[str]
    unitless: ClassVar[tuple[str, ...]]  # parameters that are not lengths

    mesh: "trimesh.Trimesh"
    parameters: Any
    frames: dict[str, Float[np.ndarray, "4 4"]]

    @property
    def fold(self) -> int:
        """Symmetry about z (`tdf_jax.geometry.symmetry`): 1 none, 2 half turns, 4 quarter turns, 0 all turns."""
        return self.parameters.fold

    @property
    def height(self) -> float:
        """Height of the body, metres."""
        return self.parameters.height

    @property
    def axis(self) -> Float[np.ndarray, "3"]:
        """Unit vector up, in the object frame."""
        return np.array([0.0, 0.0, 1.0])

    def others(self, place: str) -> tuple[Float[np.ndarray, "4 4"], ...]:
        """Frames that are as right as that of a place, such as the second of two unlike pegs.

        Args:
            place: name of the place.

        Returns:
            Frames T_object_place, (4, 4), metres, without those that the symmetry makes equal to the place.
        """
        return ()

    @staticmethod
    @abstractmethod
    def solid_of(parameters) -> Solid:
        """Parts and hollows of an object of these dimensions."""

    @cached_property
    def solid(self) -> Solid:
        """Parts and hollows of the object."""
        return self.solid_of(self.parameters)

    @property
    def clay(self) -> Solid:
        """Former name of `solid`."""
        warn(f"{type(self).__name__}.clay", f"{type(self).__name__}.solid")
        return self.solid

    def contains(self, points: Float[np.ndarray, "points 3"]) -> Bool[np.ndarray, " points"]:
        """Which points are inside the object's material, by the planes of the mesh (no ray casting).

        Args:
            points: points, (points, 3), metres, object frame.

        Returns:
            True inside, (points,).

        Raises:
            InputError: the points are not (points, 3), or not finite.
        """
        points = np.asarray(checks.coordinates(f"{type(self).__name__}.contains()", "points", points, least=0))
        inside = np.any([encloses(part, points) for part in self.solid.parts], axis=0)
        for hollow in self.solid.hollows:
            inside &= ~encloses(hollow, points)
        return inside


def solid_mesh(solid: Solid) -> "trimesh.Trimesh":
    """Mesh of a solid; the caller checks whether it is one closed body."""
    import trimesh

    fast = {"engine": "manifold", "check_volume": False}  # parts are closed by construction, and the result is checked
    parts, hollows = ([closed_mesh(rings(part)) for part in group] for group in solid)
    mesh = trimesh.boolean.union(parts, **fast) if len(parts) > 1 else parts[0]
    # Hollows are cut after the union, so that no piece of a handle remains inside them.
    return trimesh.boolean.difference([mesh, *hollows], **fast) if hollows else mesh


def is_one_body(mesh: "trimesh.Trimesh", handles: int) -> bool:
    """Whether a mesh is closed, in one piece, and has this number of handles (its genus)."""
    return mesh.is_volume and mesh.euler_number == 2 - 2 * handles and mesh.body_count == 1


def scaled(shape: Shape, factor: float) -> Shape:
    """Scale an object uniformly about the origin: mesh, frames and parameters.

    Args:
        shape: object to scale.
        factor: positive factor, no unit.

    Returns:
        A new object.

    Raises:
        InputError: the factor is not positive and finite.
    """
    checks.positive("scaled()", "factor", factor)
    lengths = [field.name for field in dataclasses.fields(shape.parameters) if field.name not in shape.unitless]
    parameters = dataclasses.replace(
        shape.parameters, **{name: getattr(shape.parameters, name) * factor for name in lengths}
    )
    grow = np.ones((4, 4))
    grow[:3, 3] = factor
    frames = {name: frame * grow for name, frame in shape.frames.items()}
    return dataclasses.replace(shape, mesh=shape.mesh.copy().apply_scale(factor), parameters=parameters, frames=frames)


def draw_valid(draw, check, rng: np.random.Generator):
    """The first drawn parameters that a check accepts."""
    while True:
        parameters = draw(rng)
        try:
            check(parameters)
        except InputError:
            continue
        return parameters


def draws(rng: np.random.Generator) -> tuple[Callable[[float, float], float], Callable[[float], bool]]:
    """Two draws of a generator: a number between two limits, and whether something of a given probability happens."""
    return lambda low, high: float(rng.uniform(low, high)), lambda probability: rng.uniform() < probability


def frame(x: float, z: float, outward: float = 1.0) -> Float[np.ndarray, "4 4"]:
    """T_object_frame at (x, 0, z), z up, its x axis along object x times `outward` (1 or -1)."""
    T = np.diag([outward, outward, 1.0, 1.0])
    T[:3, 3] = x, 0.0, z
    return T


def check_dimensions(
    function: str,
    parameters,
    *,
    may_be_zero: tuple[str, ...],
    may_be_negative: tuple[str, ...],
    choices: Mapping[str, Collection[str]] | None = None,
) -> None:
    """Raise InputError unless dimensions are finite and of the right sign, flags are bools, and words are choices."""
    for field in dataclasses.fields(parameters):
        name, value = field.name, getattr(parameters, field.name)
        try:
            if field.type is bool:
                if not isinstance(value, bool):
                    raise InputError(f"{function}: {name} is {value!r}; expected True or False")
            elif name in may_be_negative:
                checks.number(function, name, value)
            elif name in may_be_zero:
                checks.number(function, name, value, 0)
            elif choices is not None and name in choices:
                checks.choice(function, name, value, choices[name])
            else:
                checks.positive(function, name, value)
        except InputError as error:
            raise InputError(f"{error}; got {parameters}") from None
