"""Figure 2: energy landscapes of line, semicircle and wave, and of the wave over mugs and their poses."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from tdf_jax.energy.reference import Reference, describe
from tdf_jax.geometry.grid import plane_grid
from tdf_jax.geometry.trajectory import Trajectory
from tdf_jax.landscape.energy_grid import energy_landscape
from tdf_jax.networks.encoding import encode
from tdf_jax.networks.model import Model
from tdf_jax.paper import setting as settings
from tdf_jax.paper.setting import SHAPES, Setting

HALF = 1.2  # half of the edge of the square, in the paper's unit
# Degrees about z by which a mug is rotated if `Setting.turn` is no number. Its true path then stays in the plane.
UPRIGHT_TURN = 60.0
FIELDS = {  # the object in the field: number of the mug, and whether it is rotated
    "reference mug": (0, False),
    "test mug": (1, False),
    "reference mug, rotated": (0, True),
    "test mug, rotated": (1, True),
}


@dataclasses.dataclass(frozen=True)
class Swept:
    """One panel: energies in the plane through the demonstration.

    Positions are relative to the first pose, in the paper's unit.

    Attributes:
        x, y: coordinates of the grid, each (count,).
        energies: E at (x, y), (count, count).
        path: demonstrated waypoints, moved with the centroid, (poses, 2).
        carried: the same, rotated with the mug, (poses, 2).
        minimisers: x_i* of every waypoint, (poses, 2).
        outline: points of the object, projected, (points, 2).
    """

    x: Float[np.ndarray, " count"]
    y: Float[np.ndarray, " count"]
    energies: Float[np.ndarray, "count count"]
    path: Float[np.ndarray, "poses 2"]
    carried: Float[np.ndarray, "poses 2"]
    minimisers: Float[np.ndarray, "poses 2"]
    outline: Float[np.ndarray, "points 2"]


def figure2(model: Model, base: Setting, field: str, count: int = 101) -> dict[str, Swept]:
    """Landscapes of one field, one panel for each shape.

    The query frame has the axes of the world, as in the paper. A rotated mug is rotated about z, and the energy is
    still that of the axes of the world, so its minima lie where both the rotated path and the axes are near.

    Args:
        model: the network.
        base: all other numbers.
        field: one of `FIELDS`.
        count: number of points along a side of the grid.
    """
    which, turn = FIELDS[field]
    shapes = {name: dataclasses.replace(base, trajectory=name, turn=0.0) for name in SHAPES}
    scenes = {name: settings.scene(setting) for name, setting in shapes.items()}
    scene = scenes["line"]
    references = {name: describe(model, one.demonstration) for name, one in scenes.items()}
    degrees = (UPRIGHT_TURN if base.turn == "any" else base.turn) if turn else 0.0
    R = Rotation.from_euler("z", degrees, degrees=True).as_matrix()
    points = ((scene.points if which else scene.demonstration.points) @ R.T).astype(np.float32)
    seen = encode(model, jax.device_put(points))
    # Paths are relative to the centroids of the clouds, as in the losses, so they move with the centroid of a mug.
    paths = {
        name: np.asarray(reference.trajectory.translations + seen.origin) for name, reference in references.items()
    }
    pick, orientation = paths["line"][0], references["line"].trajectory.rotations[0]
    swept = energy_landscape(
        seen, _joined(list(references.values())), plane_grid(HALF * base.unit, count, pick), orientation
    )

    def flat(x):
        return (np.asarray(x) - pick)[..., :2] / base.unit

    panels = {}
    for name, part in zip(SHAPES, np.split(np.arange(len(swept.values)), len(SHAPES))):
        fields = {field: getattr(swept, field)[part] for field in ("values", "waypoints", "turned")}
        landscape = dataclasses.replace(swept, **fields, reduce=base.field_energy)
        panels[name] = Swept(
            *(steps / base.unit for steps in swept.grid.coordinates),
            energies=landscape.combined,
            path=flat(paths[name]),
            carried=flat((paths[name] - seen.origin) @ R.T + seen.origin),
            minimisers=flat(landscape.minimisers),
            outline=flat(points),
        )
    return panels


def _joined(references):
    """One reference for all shapes, because they share the query points and the field."""
    return Reference(
        jnp.concatenate([one.descriptors for one in references]),
        Trajectory(jnp.concatenate([one.trajectory.wxyz_xyz for one in references])),
        references[0].query,
    )
