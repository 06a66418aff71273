"""Clearance of random scenes: demonstrated paths that collide are pushed clear of obstacles, and measured.

python -m tdf_jax.evaluation.clearance_study --scenes 50
"""

import argparse
import time
from collections.abc import Sequence

import jax
import numpy as np
from jaxtyping import Array, Float

from tdf_jax.evaluation.study_command import at_least
from tdf_jax.geometry.distance_fields import box_obstacle
from tdf_jax.geometry.paths import SHAPES
from tdf_jax.geometry.query import gripper_query
from tdf_jax.geometry.trajectory import Trajectory
from tdf_jax.planning.avoidance import push_clear
from tdf_jax.planning.distances import clearance


def colliding_scene(seed: int, body: Float[Array, "queries 3"]) -> tuple[Trajectory, list]:
    """A path of 12 poses and three boxes.

    The body hits at least one box on the way and is clear of all boxes at both ends. Other scenes are rejected.

    Args:
        seed: seed of the scene.
        body: points of the body that moves along the path, (queries, 3), metres, query frame.
    """
    rng = np.random.default_rng(seed)
    while True:
        path = list(SHAPES.values())[rng.integers(3)](12, (0, 0, 0), (0, 0.4, 0), rotation=(0, 1, 0, 0))
        boxes = []
        for _ in range(3):
            wxyz = rng.normal(size=4)
            boxes.append(
                box_obstacle(
                    path.translations[rng.integers(2, 10)] + rng.normal(size=3) * 0.06, rng.uniform(0.01, 0.15, 3), wxyz
                )
            )
        measured = clearance(path, body, boxes, between=7)
        if measured.min < 0 and measured.waypoints[[0, -1]].min() > 0.01:
            return path, boxes


def length(path: Trajectory) -> float:
    """Length of the polyline through the waypoints, metres."""
    return float(np.linalg.norm(np.diff(np.asarray(path.translations), axis=0), axis=1).sum())


def main(arguments: Sequence[str] | None = None) -> None:
    """Push the paths of all scenes clear, and print how many succeed.

    Args:
        arguments: words of the command line; by default those of the process.
    """
    parser = argparse.ArgumentParser(
        prog="python -m tdf_jax.evaluation.clearance_study", description=(__doc__ or "").splitlines()[0]
    )
    parser.add_argument("--scenes", type=at_least(1), default=50, help="number of scenes (default: 50)")
    count = parser.parse_args(arguments).scenes
    body = gripper_query(jax.random.key(0), 300)
    rows = []
    for seed in range(count):
        path, boxes = colliding_scene(seed, body)
        start = time.perf_counter()
        cleared = push_clear(path, body, boxes)
        seconds = time.perf_counter() - start
        checked = clearance(cleared.trajectory, body, boxes, between=100).min
        rows.append((cleared.clear, checked, length(cleared.trajectory) / length(path) - 1, seconds))
        if not cleared.clear:
            print(f"scene {seed}: {cleared.status}", flush=True)
    clear, checked, longer, seconds = np.array(rows).T
    clear = clear > 0
    print(f"clear {clear.sum()} of {count}")
    if not clear.any():
        return
    print(f"smallest clearance of those at 100 points of each segment {1e3 * checked[clear].min():.2f} mm")
    print(f"added length: median {np.median(longer[clear]):.1%}, largest {longer[clear].max():.1%}")
    print(f"seconds: median {np.median(seconds):.2f}, largest {seconds.max():.2f}, first {seconds[0]:.2f}")


if __name__ == "__main__":
    main()
