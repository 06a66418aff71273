"""Parts of the placement on a target, each measured at the truth: the touch by occupancies, and the path between.

python -m tdf_jax.evaluation.relation_study touch --pairs 20
python -m tdf_jax.evaluation.relation_study paths --pairs 20
"""

import argparse
import functools
from collections.abc import Sequence
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from tdf_jax.energy.seating import touch_distance
from tdf_jax.evaluation.relation_success import signed_distances
from tdf_jax.evaluation.relation_tasks import POSES, RELATIONS, Placement, demonstrate, draw_pair, place_pair
from tdf_jax.evaluation.study_command import at_least
from tdf_jax.evaluation.tabletop import moved
from tdf_jax.geometry import se3
from tdf_jax.geometry.demonstration import Demonstration
from tdf_jax.geometry.sampling import sample_surface
from tdf_jax.geometry.trajectory import Trajectory, resample
from tdf_jax.geometry.transport import ARRIVAL, arrival_depth, arrival_of, carry_to_target, carry_trajectory
from tdf_jax.networks.checkpoint import load_model
from tdf_jax.networks.encoding import encode
from tdf_jax.networks.model import Model
from tdf_jax.shapes import Shape

SEED = 300  # a development seed
FIRST_DEMONSTRATION = 1000  # pairs from here on demonstrate
INSIDE = 0.002  # metres inside the target at which a path counts as colliding
NEAR = 0.02  # metres around the target's box within which points of the object are measured
LAST = 0.03  # metres at the end of a path whose direction is compared
WAYPOINTS = 60  # of each path
POINTS = 800  # surface points of each object that are tested, and as many corners of its mesh
BESIDE = 0.15  # metres from where the object stood within which its support counts
# Low and high corners of a gripper's hand in the frame of the place that it picks, metres; its fingers are below.
HAND = (-0.04, -0.02, 0.02), (0.04, 0.02, 0.12)
BEFORE = 5  # first poses that are left out: the object is still where it lay


def touches(
    task: str, object_model: Model, target_model: Model | None, clouds: str, pairs: int, seed: int = SEED
) -> Float[np.ndarray, " pairs"]:
    """How far down true placements touch by occupancies, metres; with the margin of `touch_distance`, -6e-4 is exact.

    Args:
        task: name of the task.
        object_model: network of the object.
        target_model: network of the target; None to use the object's occupancy alone.
        clouds: condition of both clouds.
        pairs: number of pairs.
        seed: seed of the pairs.

    Returns:
        The displacements, (pairs,); NaN where the two do not touch within reach.
    """
    found = []
    for number in range(pairs):
        placement = place_pair(draw_pair(task, seed, number), seed, "upright", clouds)
        target = None if target_model is None else encode(target_model, placement.target_points)
        field = encode(object_model, placement.points)
        down = -placement.T_world_target[:3, 2]
        motion = _pose(placement.motion)
        found.append(touch_distance(field, target, placement.points, placement.target_points, motion, down))
    return np.array(found)


class Measured(NamedTuple):
    """What a path does between the pick and the goal.

    Attributes:
        clearance: smallest signed distance of points of the carried object from the target's surface, or of the
            target's points from the object's, metres, at most `NEAR`.
        gripper: that of points of a gripper's hand from the target's surface.
        support: how far the carried object or the hand dips below the horizontal plane that the object stood on, within
            `BESIDE` of where it stood, metres.
        approach: angle between the last `LAST` of the path and the demonstrated approach, degrees.
    """

    clearance: float
    gripper: float
    support: float
    approach: float


def paths(task: str, poses: str, number: int, seed: int = SEED) -> dict[str, Measured]:
    """Clearances and the error of the approach of paths to the true pick and goal of a pair.

    Args:
        task: name of the task.
        poses: poses of both objects.
        number: number of the pair.
        seed: seed of the pairs.

    Returns:
        What is measured, by the name of the warping.
    """
    demonstration = demonstrate(draw_pair(task, seed, FIRST_DEMONSTRATION + number), 0)
    pair = draw_pair(task, seed, number)
    placement = place_pair(pair, seed, poses)
    target = demonstration.target
    assert target is not None
    grasp = pair.object.frames[RELATIONS[task].grasp]
    pick = placement.T_world_object @ grasp
    goal = placement.T_world_target @ pair.T_target_object @ grasp
    T_world_contact = np.asarray(Trajectory(jnp.asarray(target.T_world_contact)[None]).matrices[0], float)
    moves = placement.T_world_target @ pair.T_target_contact @ np.linalg.inv(T_world_contact)
    path, arrival = resample(demonstration.trajectory, WAYPOINTS), arrival_of(demonstration)
    released = moved(placement.points.astype(float), placement.motion)
    depth = arrival_depth(released, placement.target_points.astype(float), moves[:3, :3] @ arrival.outward)
    ends = path, _pose(pick), _pose(goal)
    stretched = functools.partial(
        carry_to_target, *ends, _pose(moves), arrival=arrival.length, deeper=max(0.0, depth - arrival.depth)
    )
    warped = {
        "even": carry_trajectory(*ends),
        f"arrival of {100 * ARRIVAL:.0f} cm": carry_to_target(*ends, _pose(moves)),
        "arrival as demonstrated": carry_to_target(*ends, _pose(moves), arrival=arrival.length),
        "weights by nearness": stretched(shares=_nearness(demonstration, path)),
        "departure relative to the object": stretched(upright=False),
        "departure upwards": stretched(),
    }
    approach = -pair.T_target_contact[:3, 0] if task == "mug_on_rack" else np.array([0.0, 0.0, -1.0])
    samples = _samples(pair.object), _samples(pair.target)
    return {name: _measured(placement, grasp, one, samples, approach) for name, one in warped.items()}


def _samples(shape: Shape) -> Float[np.ndarray, "points 3"]:
    """Points all over a surface, and some of its corners, which are what touches first."""
    corners = shape.mesh.vertices[:: max(1, len(shape.mesh.vertices) // POINTS)]
    return np.concatenate([sample_surface(shape.mesh, POINTS, np.random.default_rng(0)), corners])


def _nearness(demonstration: Demonstration, path: Trajectory) -> Array:
    """Weight of the goal's side at every pose: the nearer the demonstrated object is to its target, the more.

    A field knows a place the better, the nearer it is: the distances are those of the carried object to where it stood
    and to its target.
    """
    from scipy.spatial import KDTree

    assert demonstration.target is not None
    T = np.asarray(path.matrices, float)
    motions = T @ np.linalg.inv(T[0])
    cloud = np.asarray(demonstration.points, float)[::5]
    left = np.array([np.linalg.norm(moved(cloud, M) - cloud, axis=1).mean() for M in motions])
    tree = KDTree(np.asarray(demonstration.target.points, float))
    gaps = np.array([tree.query(moved(cloud, M))[0].min() for M in motions])
    gaps = np.maximum(gaps - gaps[-1], 0)
    return jnp.asarray(left / np.maximum(left + gaps, 1e-9), jnp.float32)


def _measured(placement: Placement, grasp, path: Trajectory, samples, approach) -> Measured:
    T_world_gripper, one, target = np.asarray(path.matrices, float), placement.pair.object, placement.pair.target
    T_world_object = T_world_gripper @ np.linalg.inv(grasp)
    there = np.linalg.inv(placement.T_world_target)
    T_target_object = there @ T_world_object
    object_points, hand = (
        np.stack([moved(points, T) for T in poses])
        for points, poses in ((samples[0], T_world_object), (_gripper_box(), T_world_gripper))
    )
    low, middle = object_points[0, :, 2].min(), object_points[0].mean(axis=0)
    both = np.concatenate([object_points, hand], axis=1)
    beside = np.linalg.norm(both[..., :2] - middle[:2], axis=2) < BESIDE
    # Points of either in the other: a thin peg may cross a wall between the wall's points.
    inside = [_clearance(target, moved(points, there)) for points in object_points[BEFORE:-1]]
    inside += [_clearance(one, moved(samples[1], np.linalg.inv(T))) for T in T_target_object[BEFORE:-1]]
    return Measured(
        min(inside),
        min(_clearance(target, moved(points, there)) for points in hand[BEFORE:-1]),
        float(low - both[..., 2][beside].min()),
        _angle(T_target_object[:, :3, 3], approach),
    )


def _gripper_box() -> Float[np.ndarray, "points 3"]:
    """Points on the surface of a gripper's hand, above the place that it picks, in the frame of that place."""
    sides = [np.linspace(low, high, 9) for low, high in zip(*HAND)]
    grid = np.stack(np.meshgrid(*sides, indexing="ij"), axis=-1).reshape(-1, 3)
    return grid[(np.isclose(grid, HAND[0]) | np.isclose(grid, HAND[1])).any(axis=1)]


def _clearance(target, points) -> float:
    low, high = target.mesh.bounds
    near = points[((points > low - NEAR) & (points < high + NEAR)).all(axis=1)]
    return min(NEAR, float(signed_distances(target, near)[0].min())) if len(near) else NEAR


def _angle(places, approach) -> float:
    """Angle between the last part of a path and a direction, degrees."""
    left = np.cumsum(np.linalg.norm(np.diff(places[::-1], axis=0), axis=1))
    last = places[-1] - places[-2 - min(int(np.searchsorted(left, LAST)), len(places) - 2)]
    return float(np.degrees(np.arccos(np.clip(last @ approach / np.linalg.norm(last), -1, 1))))


def _pose(T: Float[np.ndarray, "4 4"]) -> Float[Array, "7"]:
    return jnp.asarray(se3.pose(jnp.asarray(T[:3, :3], jnp.float32), jnp.asarray(T[:3, 3], jnp.float32)))


def main(arguments: Sequence[str] | None = None) -> None:
    """Measure one part, and print it.

    Args:
        arguments: words of the command line; by default those of the process.
    """
    parser = argparse.ArgumentParser(
        prog="python -m tdf_jax.evaluation.relation_study", description=(__doc__ or "").splitlines()[0]
    )
    parser.add_argument("part", choices=("touch", "paths"), help="what is measured")
    parser.add_argument("--pairs", type=at_least(1), default=20, help="number of pairs of each row (default: 20)")
    settings = parser.parse_args(arguments)
    if settings.part == "touch":
        bowl, mug = load_model("bowl"), load_model("mug")
        rows = [("bowl_on_mug", bowl, mug, clouds) for clouds in ("full", "views4", "views1")]
        for task, one, other, clouds in [*rows, ("mug_on_rack", mug, None, "full")]:
            found = 1e3 * touches(task, one, other, clouds, settings.pairs)
            print(
                f"{task}, {clouds}: touch within 2 mm of {np.mean(np.abs(found) < 2):.0%}, median "
                f"{np.nanmedian(found):.1f} mm, no touch in {np.isnan(found).sum()} pairs",
                flush=True,
            )
        return
    for task in RELATIONS:
        for poses in POSES:
            every = [paths(task, poses, number) for number in range(settings.pairs)]
            for name in every[0]:
                clearance, gripper, support, approach = np.array([one[name] for one in every]).T
                print(
                    f"{task}, {poses}, {name}: inside the target on {np.mean(clearance < -INSIDE):.0%} of the paths, "
                    f"the gripper on {np.mean(gripper < -INSIDE):.0%}, below the support on "
                    f"{np.mean(support > INSIDE):.0%}, approach off by {np.median(approach):.0f} degrees (median)",
                    flush=True,
                )


if __name__ == "__main__":
    main()
