"""What every competitor is given: the shipped weights under the checkpoints' names, and one imitation's clouds, poses and query points."""

import functools

import jax
import numpy as np
from flax.traverse_util import flatten_dict
from jaxtyping import Float
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

import tdf_jax as tdf
from tdf_jax.evaluation.cases import mug_of

HEIGHT = 0.12  # metres
NEAR = 0.01  # metres from the surface: "inside", for training's labels; only the time of the loss counts


def weights(model: tdf.Model) -> dict[str, np.ndarray]:
    """A model's tensors as a PyTorch state_dict has them: (out, in)."""
    tensors = flatten_dict(model.params, sep=".")
    return {name.replace(".kernel", ".weight"): np.asarray(tensor).T for name, tensor in tensors.items()}


@functools.cache
def _surface(index, count):
    return tdf.sample_surface(mug_of(0, index, HEIGHT).mesh, count, index).astype(np.float32)


def cloud(points: int) -> Float[np.ndarray, "points 3"]:
    """A generated mug's surface, centred, metres."""
    surface = _surface(1, points)
    return surface - surface.mean(axis=0)


def imitation(inits: int, poses: int, queries: int, seed: int = 0) -> dict[str, np.ndarray]:
    """A wave shown at one mug's handle, and random starts at another mug.

    Clouds are of the weights' density, so that one encoding, the same in all competitors, is enough.

    Returns:
        shown, new: clouds (256, 3); path: the demonstration (poses, 7); query: (queries, 3); goal: (7,); starts (inits,
        poses, 7), the demonstration turned about the object as a whole by a uniform rotation, ending at the goal.
        Metres, `wxyz_xyz`, world frame.
    """
    shown, new = (tdf.thin(_surface(index, 1500), 256) for index in (0, 1))
    turn = Rotation.random(random_state=seed)
    new = (turn.apply(new) + (0.1, -0.05, 0.02)).astype(np.float32)
    handle = mug_of(0, 0, HEIGHT).handle_frame[:3, 3]
    path = np.asarray(tdf.wave(poses, start=handle, end=handle + [0.0, 0.3, 0.1]).wxyz_xyz, np.float64)
    origins = shown.mean(axis=0, dtype=np.float64), new.mean(axis=0, dtype=np.float64)
    goal = path[-1] + [0, 0, 0, 0, *(origins[1] - origins[0])]
    starts = []
    for rotation in Rotation.random(inits, random_state=seed + 1):
        turned = (rotation * Rotation.from_quat(path[:, :4], scalar_first=True)).as_quat(scalar_first=True)
        starts.append(np.concatenate([turned, rotation.apply(path[:, 4:] - origins[0]) + origins[1]], axis=1))
        starts[-1][-1] = goal
    query = tdf.box_query(jax.random.key(seed), count=queries, size=0.08)
    arrays = {"shown": shown, "new": new, "path": path, "query": query, "goal": goal, "starts": np.stack(starts)}
    weights = tdf.EnergyWeights()
    arrays |= {"correlation": weights.correlation, "lever": weights.lever}
    return {name: np.asarray(array, np.float32) for name, array in arrays.items()}


def batch(clouds: int, points: int, queries: int) -> dict[str, np.ndarray]:
    """A training batch: clouds (clouds, points, 3), queries (clouds, queries, 3) and labels (clouds, queries)."""
    rng = np.random.default_rng(0)
    centred = np.stack(
        [tdf.thin(cloud(1500) @ Rotation.random(random_state=i).as_matrix().T, points) for i in range(clouds)]
    )
    centred -= centred.mean(axis=1, keepdims=True)
    low, high = centred.min(axis=1, keepdims=True), centred.max(axis=1, keepdims=True)
    x = rng.uniform(low, high, (clouds, queries, 3))
    inside = np.stack([cKDTree(surface).query(some)[0] < NEAR for surface, some in zip(centred, x)])
    return {
        name: np.asarray(array, np.float32) for name, array in (("clouds", centred), ("queries", x), ("inside", inside))
    }


def plane(count: int, pitch: float, points: Float[np.ndarray, "points 3"]) -> tdf.Grid:
    """A square of the horizontal plane through a cloud's mean."""
    return tdf.plane_grid(pitch * (count - 1) / 2, count, points.mean(axis=0, dtype=np.float64))


def sweep(count: int, rotations: int, poses: int, lattice: tuple[int, int, int], pitch: float) -> dict[str, np.ndarray]:
    """An imitation whose query is a lattice, the plane grid about the handle, and turns about the vertical.

    Returns:
        As `imitation`, and grid: world points (count, count, 3); rotations: (rotations, 3, 3). With an even number of
        turns half a turn apart, one or two put the lattice's axes along the grid's, where it can be shared; the others
        do not.
    """
    arrays = imitation(1, poses, 1)
    grid = plane(count, pitch, arrays["new"])
    angles = np.arange(rotations) * np.pi / rotations
    turns = Rotation.from_rotvec(angles[:, None] * [0.0, 0.0, 1.0]).as_matrix()
    arrays |= {"query": np.asarray(tdf.lattice_query(lattice, pitch), np.float32)}
    return arrays | {"grid": grid.points.astype(np.float32), "rotations": turns.astype(np.float32)}
