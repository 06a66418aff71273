"""Rigid bodies for the physics: convex parts, mass and inertia of generated objects and of users' meshes."""

import dataclasses
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Float

from tdf_jax._internal import checks
from tdf_jax.shapes import Shape
from tdf_jax.shapes.convex import convex_parts
from tdf_jax.sim.board import Board
from tdf_jax.sim.physics import object_mass

if TYPE_CHECKING:
    import trimesh


@dataclasses.dataclass(frozen=True, eq=False)
class Body:
    """A rigid body in its own frame.

    Attributes:
        parts: corners of convex parts, (corners, 3) each, metres.
        mass: mass, kg.
        centre: centre of mass, (3,), metres.
        inertia: inertia about it, (3, 3), kg m2.
        mesh: its surface, for pictures, clouds and tests.
    """

    parts: list[Float[np.ndarray, "_ 3"]]
    mass: float
    centre: Float[np.ndarray, "3"]
    inertia: Float[np.ndarray, "3 3"]
    mesh: "trimesh.Trimesh"


def body_of(shape: Shape | Board, mass: float | None = None) -> Body:
    """The body of a generated object or a board: material of even density.

    Args:
        shape: the object.
        mass: mass, kg; by default by its volume, see `tdf_jax.sim.physics.object_mass`.
    """
    if mass is not None:
        checks.positive("body_of()", "mass", mass, "kg")
    mesh = shape.mesh
    used = object_mass(float(mesh.volume)) if mass is None else float(mass)
    return Body(
        parts=shape.boxes if isinstance(shape, Board) else convex_parts(shape),
        mass=used,
        centre=np.asarray(mesh.center_mass, float),
        inertia=np.asarray(mesh.moment_inertia, float) * (used / float(mesh.mass)),
        mesh=mesh,
    )
