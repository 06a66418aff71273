"""Figure 2: energy landscapes of line, semicircle and wave, and of the wave over mugs and their poses."""

import dataclasses

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

HALF = 1.2  # of the square's side, in the paper's unit
# degrees about z of the turned mugs, whose true paths so stay in the plane; `Setting.turn` if it is a number
UPRIGHT_TURN = 60.0
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
        path: the demonstration's waypoints, relative to the cloud's centre.
        carried: the same, turned with the mug.
        minimisers: x_i* of every waypoint.
        outline: points of the object, projected.
    """

    x: Float[np.ndarray, " count"]
    y: Float[np.ndarray, " count"]
    energies: Float[np.ndarray, "count count"]
    path: Float[np.ndarray, "poses 2"]
    carried: Float[np.ndarray, "poses 2"]
    minimisers: Float[np.ndarray, "poses 2"]
    outline: Float[np.ndarray, "points 2"]


def figure2(model: Model, base: Setting, field: str, count: int = 101) -> dict[str, Swept]:
    """Landscapes of one field, a panel a shape.

    The query frame has the world's axes, as in the paper: the handle's frame is not tilted. A turned mug is turned
    about z, and the energy is still that of the world's axes, so its minima lie where both the turned path and the axes
    are near.

    Args:
        model: the network.
        base: all other numbers.
        field: one of `FIELDS`.
        count: points along a side of the grid.
    """
    which, turn = FIELDS[field]
    shapes = {name: dataclasses.replace(base, trajectory=name, turn=0.0) for name in SHAPES}
    scenes = {name: settings.scene(setting) for name, setting in shapes.items()}
    scene = scenes["line"]
    references = {name: describe(model, one.demonstration) for name, one in scenes.items()}
    degrees = (UPRIGHT_TURN if base.turn == "any" else base.turn) if turn else 0.0
    R = Rotation.from_euler("z", degrees, degrees=True).as_matrix()
    points = ((scene.points if which else scene.demonstration.points) @ R.T).astype(np.float32)
    seen = encode(model, points)
    # The paths are relative to the clouds' centres, as in the losses: on another mug they lie where its centre takes
    # them.
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
    """One sweep for all shapes: they share the query points and the field."""
    return Reference(
        jnp.concatenate([one.descriptors for one in references]),
        Trajectory(jnp.concatenate([one.trajectory.wxyz_xyz for one in references])),
        references[0].query,
    )
