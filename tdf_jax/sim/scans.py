"""Objects of users' annotated meshes in episodes: what tasks and physics need of them, measured on the meshes."""

import dataclasses
import functools
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from tdf_jax._internal import checks
from tdf_jax._internal.cache import digest
from tdf_jax._internal.errors import InputError
from tdf_jax.evaluation.annotated_meshes import AnnotatedMesh, load_annotated
from tdf_jax.evaluation.places import crossings
from tdf_jax.geometry.winding import libigl, winding_number
from tdf_jax.sim.bodies import Body
from tdf_jax.sim.decomposition import mesh_body
from tdf_jax.sim.physics import extra

ROWS = 1000  # horizontal lines through a handle
BEYOND = 0.001  # metres outside the wall, from which a surface is one of the handle


class Handle(NamedTuple):
    """A mug's handle on the section through its plane of symmetry.

    Attributes:
        handle_thickness: thickness of the bar, half way between its attachments, metres.
        hole: outline around the finger hole in the x-z plane, (corners, 2), metres, object frame: along the wall and
            the bar's middle.
    """

    handle_thickness: float
    hole: Float[np.ndarray, "corners 2"]


@dataclasses.dataclass(frozen=True, eq=False)
class Scan:
    """An annotated mesh with what `tdf_jax.shapes.Shape` has, as far as episodes need it.

    Attributes:
        annotated: the mesh in its canonical frame, with its places.
    """

    annotated: AnnotatedMesh

    @property
    def name(self) -> str:
        """Path of its file in the folder, without the suffix."""
        return self.annotated.name

    @property
    def category(self) -> str:
        """Category of the object."""
        return self.annotated.category

    @property
    def fold(self) -> int:
        """Symmetry about z, see `tdf_jax.geometry.symmetry`."""
        return self.annotated.fold

    @property
    def height(self) -> float:
        """Height of the body, metres."""
        return self.annotated.height

    @property
    def frames(self) -> dict[str, Float[np.ndarray, "4 4"]]:
        """T_object_place by the name of the place, 4x4: annotated, or measured on the mesh."""
        return self.annotated.frames

    @property
    def handle_frame(self) -> Float[np.ndarray, "4 4"]:
        """Frame of a mug's handle, 4x4."""
        return self.frames["handle"]

    @functools.cached_property
    def body(self) -> Body:
        """Its body for the physics, of convex parts; the first time takes up to minutes."""
        return mesh_body(self.annotated.mesh)

    @functools.cached_property
    def mesh(self):
        """The mesh, metres; its centre of mass is that of the body, also if it is not closed."""
        mesh = self.annotated.mesh.copy()
        mesh.center_mass = self.body.centre
        return mesh

    @property
    def parameters(self) -> Handle:
        """What is measured of a mug's handle, under the names that a generated mug has them."""
        return self._handle

    @property
    def finger_hole(self) -> Float[np.ndarray, "corners 2"]:
        """Outline around a mug's finger hole in the x-z plane, (corners, 2), metres."""
        return self._handle.hole

    @functools.cached_property
    def digest(self) -> str:
        """SHA-256 of all that outcomes depend on."""
        mesh, frames = self.annotated.mesh, self.annotated.frames
        places = [np.asarray(frames[name], float) for name in sorted(frames)]
        return digest(self.category.encode(), np.array(self.fold), mesh.vertices, mesh.faces, self.height, *places)

    def contains(self, points: Float[np.ndarray, "points 3"]) -> Bool[np.ndarray, " points"]:
        """Which points are inside the material, by the winding number.

        Args:
            points: points, (points, 3), metres, object frame.
        """
        return np.abs(winding_number(self.annotated.mesh, points)) > 0.5

    @functools.cached_property
    def _handle(self) -> Handle:
        from trimesh.intersections import mesh_plane

        # Just beside the plane of symmetry, in which whole edges may lie.
        section = mesh_plane(self.annotated.mesh, plane_normal=[0, 1, 0], plane_origin=[0, 1e-6, 0])
        section = np.asarray(section)[..., [0, 2]]
        low, high = self.annotated.mesh.bounds[:, 2]
        step = (high - low) / ROWS
        levels = low + step * (np.arange(ROWS) + 0.5)
        rows = [crossings(section, level) for level in levels]
        # The wall on the side without the handle, mirrored.
        wall = np.array([-row[0] if len(row) and row[0] < 0 else np.nan for row in rows])
        wall = np.interp(levels, levels[np.isfinite(wall)], wall[np.isfinite(wall)])
        beyond = [row[row > edge + BEYOND] for row, edge in zip(rows, wall)]
        # The hole has the two surfaces of the bar to its right; an arm has one.
        middle = int(np.clip(np.searchsorted(levels, self.handle_frame[2, 3]), 0, ROWS - 1))
        has_bar = [len(row) == 2 for row in beyond]
        if not has_bar[middle]:
            raise InputError(
                f"tdf simulate: no finger hole is found at the handle of {self.name}, "
                f"{1e3 * self.handle_frame[2, 3]:.0f} mm from the middle of its height; expected a closed handle along "
                "+x; correct its 'handle' and its place in meshes.json"
            )
        first, last = middle, middle
        while first > 0 and has_bar[first - 1]:
            first -= 1
        while last < ROWS - 1 and has_bar[last + 1]:
            last += 1
        span = slice(first, last + 1)
        bars = np.array(beyond[span])
        right = np.column_stack([bars.mean(axis=1), levels[span]])
        left = np.column_stack([wall[span], levels[span]])
        return Handle(float(np.ptp(beyond[middle])), np.concatenate([left, right[::-1]]))


def load_scans(function: str, folder: Path, recursive: bool, category: str) -> list[Scan]:
    """Read the objects of a category in a folder of annotated meshes, in the order of their names.

    Args:
        function: begins the messages.
        folder: the folder, with a meshes.json; see `tdf_jax.evaluation.annotated_meshes`.
        recursive: read the meshes in subfolders too.
        category: category of the objects; others are left out.

    Raises:
        InputError: the folder cannot be used, has no such object, or a package is missing.
    """
    libigl(function)
    extra(function, "coacd")
    found = load_annotated(checks.path(function, folder, "--meshes"), recursive)
    mine = [Scan(one) for one in found if one.category == category]
    if not mine:
        others = ", ".join(sorted({one.category for one in found}))
        raise InputError(
            f"{function}: --meshes is {folder}, which has no {category} but {others}; expected at least one mesh with "
            f'"category": "{category}" in its meshes.json'
        )
    return mine
