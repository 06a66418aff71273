"""Figure 2: energy landscapes of line, semicircle and wave, and of the wave over mugs and their poses."""

import dataclasses

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from tdf_jax.demonstration import Reference, describe, thinned
from tdf_jax.experiments import setting as settings
from tdf_jax.experiments.setting import SHAPES, Setting
from tdf_jax.landscape import Landscape, energy_landscape, plane
from tdf_jax.model import Model, encode
from tdf_jax.trajectory import Trajectory

HALF = 1.2  # of the square's side, in the paper's unit
FIELDS = {  # what lies in the field, in words: which mug, and whether it is turned
    "reference mug": (0, False),
    "test mug": (1, False),
    "reference mug, turned": (0, True),
    "test mug, turned": (1, True),
}


@dataclasses.dataclass(frozen=True)
class Swept:
    """One panel: energies in the plane through the demonstration, positions relative to its first pose, in the paper's unit.

    Attributes:
        x, y: coordinates of the grid.
        energies: E at (x, y).
        path: the demonstration's waypoints.
        minimisers: x_i* of every waypoint.
        outline: points of the object, projected.
    """

    x: Float[np.ndarray, " count"]
    y: Float[np.ndarray, " count"]
    energies: Float[np.ndarray, "count count"]
    path: Float[np.ndarray, "poses 2"]
    minimisers: Float[np.ndarray, "poses 2"]
    outline: Float[np.ndarray, "points 2"]


def figure2(model: Model, base: Setting, field: str, count: int = 101) -> dict[str, Swept]:
    """Landscapes of one field, a panel a shape.

    The query frame keeps the demonstration's axes, the world's up to the tilt of the handle; the paper's are the identity.

    Args:
        model: the network.
        base: all other numbers.
        field: one of `FIELDS`.
        count: points along a side of the grid.
    """
    which, turn = FIELDS[field]
    shapes = {name: dataclasses.replace(base, trajectory=name, turn=base.turn if turn else 0.0) for name in SHAPES}
    scenes = {name: settings.scene(setting) for name, setting in shapes.items()}
    scene = scenes["line"]
    references = {name: describe(model, one.demonstration) for name, one in scenes.items()}
    points = scene.points if which else (scene.demonstration.points @ settings.rotation(shapes["line"]).T).astype(np.float32)
    trajectory = scene.demonstration.trajectory
    # The query follows the centroid, as the losses do: relative to it, both mugs lie in one place.
    seen = encode(model, thinned(model, points))
    shift = np.asarray(seen.origin) - scene.demonstration.points.mean(axis=0)
    pick = np.asarray(trajectory.translations[0]) + shift
    swept = energy_landscape(seen, _joined(list(references.values())), plane(HALF * base.unit, count, pick), trajectory.rotations[0])
    n = base.poses
    return {
        name: _panel(Landscape(swept.grid, swept.values[n * index : n * (index + 1)]), scenes[name], points, pick, shift, base.unit)
        for index, name in enumerate(SHAPES)
    }


def _joined(references):
    """One sweep for all shapes: they share the query points and the field."""
    return Reference(
        jnp.concatenate([one.descriptors for one in references]),
        Trajectory(jnp.concatenate([one.trajectory.wxyz_xyz for one in references])),
        references[0].query,
    )


def _panel(landscape, scene, points, pick, shift, unit):
    def flat(x):
        return (np.asarray(x) - pick)[..., :2] / unit

    return Swept(
        x=landscape.grid.coordinates[0] / unit,
        y=landscape.grid.coordinates[1] / unit,
        energies=landscape.least,
        path=flat(np.asarray(scene.demonstration.trajectory.translations) + shift),
        minimisers=flat(landscape.minimisers),
        outline=flat(points),
    )
