"""What all generated objects share: a mesh with ground truth, an exact inside test, frames of places, a symmetry."""

import dataclasses
from abc import ABC, abstractmethod
from functools import cached_property
from numbers import Real
from typing import TYPE_CHECKING, Any, ClassVar, NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from tdf_jax._internal.errors import InputError
from tdf_jax.shapes.solid import Part, encloses, rings, skin

if TYPE_CHECKING:
    import trimesh


class Clay(NamedTuple):
    """Parts that are joined, and hollows that are cut out of them after."""

    joined: tuple[Part, ...]
    hollows: tuple[Part, ...]


@dataclasses.dataclass(frozen=True, eq=False)
class Shape(ABC):
    """One generated object; its canonical frame has z up along its axis and the origin on it, at half the body's height.

    Attributes:
        mesh: watertight, normals outward, metres; the clay only, cavities are open.
        parameters: what it was built from; lengths in metres.
        frames: T_object_frame of its semantic places by name, 4x4, metres.
    """

    category: ClassVar[str]
    unitless: ClassVar[tuple[str, ...]]  # parameters that are no lengths

    mesh: "trimesh.Trimesh"
    parameters: Any
    frames: dict[str, Float[np.ndarray, "4 4"]]

    @property
    def fold(self) -> int:
        """Its symmetry about z: 1 none, 2 half turns, 4 quarters, 0 any turn leave it as it is (`tdf_jax.geometry.symmetry`)."""
        return self.parameters.fold

    @property
    def height(self) -> float:
        """Of the body, metres."""
        return self.parameters.height

    @property
    def axis(self) -> Float[np.ndarray, "3"]:
        """Unit vector up, in the object frame."""
        return np.array([0.0, 0.0, 1.0])

    @staticmethod
    @abstractmethod
    def clay_of(parameters) -> Clay:
        """The parts of an object of these parameters."""

    @cached_property
    def clay(self) -> Clay:
        """Its parts."""
        return self.clay_of(self.parameters)

    def contains(self, points: Float[np.ndarray, "points 3"]) -> Bool[np.ndarray, " points"]:
        """Tell which points lie in the clay, by the planes of the mesh (no ray casting).

        Args:
            points: (points, 3), metres, object frame.

        Returns:
            (points,) True inside.

        Raises:
            InputError: the points are not (points, 3), or not finite.
        """
        points, name = np.asarray(points), type(self).__name__
        if points.ndim != 2 or points.shape[1] != 3:
            raise InputError(f"{name}.contains(): points have shape {points.shape}; expected (points, 3)")
        if not np.isfinite(points).all():
            raise InputError(
                f"{name}.contains(): points hold NaN or infinite numbers; expected finite metres; remove them"
            )
        clay = np.any([encloses(part, points) for part in self.clay.joined], axis=0)
        for hollow in self.clay.hollows:
            clay &= ~encloses(hollow, points)
        return clay


def moulded(clay: Clay) -> "trimesh.Trimesh":
    """The mesh of parts; whether it is one closed body is for the caller to check."""
    import trimesh

    fast = {"engine": "manifold", "check_volume": False}  # the parts are closed by construction; the result is checked
    joined, hollows = ([skin(rings(part)) for part in parts] for parts in clay)
    mesh = trimesh.boolean.union(joined, **fast) if len(joined) > 1 else joined[0]
    # Hollows are cut after everything is joined: nothing of a handle is left inside them.
    return trimesh.boolean.difference([mesh, *hollows], **fast) if hollows else mesh


def is_one_body(mesh: "trimesh.Trimesh", handles: int) -> bool:
    """Whether a mesh is closed, in one piece, and has so many holes to put a finger through."""
    return mesh.is_volume and mesh.euler_number == 2 - 2 * handles and mesh.body_count == 1


def scaled(shape: Shape, factor: float) -> Shape:
    """Scale an object uniformly about the origin: mesh, frames and parameters.

    Args:
        shape: the object.
        factor: positive, no unit.

    Returns:
        A new object.

    Raises:
        InputError: the factor is not positive and finite.
    """
    if not (np.isfinite(factor) and factor > 0):
        raise InputError(f"scaled(): factor is {factor}; expected a positive number")
    lengths = [field.name for field in dataclasses.fields(shape.parameters) if field.name not in shape.unitless]
    parameters = dataclasses.replace(
        shape.parameters, **{name: getattr(shape.parameters, name) * factor for name in lengths}
    )
    grow = np.ones((4, 4))
    grow[:3, 3] = factor
    frames = {name: frame * grow for name, frame in shape.frames.items()}
    return dataclasses.replace(shape, mesh=shape.mesh.copy().apply_scale(factor), parameters=parameters, frames=frames)


def accepted(draw, check, rng: np.random.Generator):
    """The first drawn parameters that a check does not refuse."""
    while True:
        parameters = draw(rng)
        try:
            check(parameters)
        except InputError:
            continue
        return parameters


def frame(x: float, z: float, outward: float = 1.0) -> Float[np.ndarray, "4 4"]:
    """T_object_frame at (x, 0, z), z up, its x axis along object x times `outward` (1 or -1)."""
    T = np.diag([outward, outward, 1.0, 1.0])
    T[:3, 3] = x, 0.0, z
    return T


def check_numbers(function: str, parameters, *, may_be_zero: tuple[str, ...], may_be_negative: tuple[str, ...]) -> None:
    """Raise InputError unless all parameters but names are finite numbers of the right sign."""
    for field in dataclasses.fields(parameters):
        name, value = field.name, getattr(parameters, field.name)
        if field.type is str:
            continue
        wrong = None
        if field.type is bool:
            wrong = None if isinstance(value, bool) else f"{name} is {value!r}; expected True or False"
        elif not (isinstance(value, Real) and np.isfinite(value)):
            wrong = f"{name} is {value!r}; expected a finite number"
        elif not (value > 0 or name in may_be_zero or name in may_be_negative):
            wrong = f"{name} is {value}; expected a positive number"
        elif not (value >= 0 or name in may_be_negative):
            wrong = f"{name} is {value}; expected zero or a positive number"
        if wrong:
            raise InputError(f"{function}(): {wrong}; got {parameters}")
