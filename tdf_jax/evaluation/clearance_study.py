"""Random scenes in which replay collides, pushed clear: python -m tdf_jax.evaluation.clearance_study."""

import argparse
import time

import jax
import numpy as np

from tdf_jax.geometry.distance_fields import box_obstacle
from tdf_jax.geometry.paths import SHAPES
from tdf_jax.geometry.query import gripper_query
from tdf_jax.planning.avoidance import push_clear
from tdf_jax.planning.distances import clearance


def scene(seed: int, body):
    """A path of 12 poses and three boxes, one or more of which the body hits on the way and none at the ends; others are drawn again."""
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
        found = clearance(path, body, boxes, between=7)
        if found.least < 0 and found.waypoints[[0, -1]].min() > 0.01:
            return path, boxes


def length(path) -> float:
    return float(np.linalg.norm(np.diff(np.asarray(path.translations), axis=0), axis=1).sum())


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--scenes", type=int, default=50)
    count = parser.parse_args().scenes
    if count < 1:
        parser.error(f"--scenes is {count}; expected at least 1")
    body = gripper_query(jax.random.key(0), 300)
    rows = []
    for seed in range(count):
        path, boxes = scene(seed, body)
        start = time.perf_counter()
        cleared = push_clear(path, body, boxes)
        seconds = time.perf_counter() - start
        checked = clearance(cleared.trajectory, body, boxes, between=100).least
        rows.append((cleared.clear, checked, length(cleared.trajectory) / length(path) - 1, seconds))
        if not cleared.clear:
            print(f"scene {seed}: {cleared.status}", flush=True)
    clear, checked, longer, seconds = np.array(rows).T
    clear = clear > 0
    print(f"clear {clear.sum()} of {count}")
    if not clear.any():
        return
    print(f"least clearance of those by 100 looks a segment {1e3 * checked[clear].min():.2f} mm")
    print(f"length added: median {np.median(longer[clear]):.1%}, largest {longer[clear].max():.1%}")
    print(f"seconds: median {np.median(seconds):.2f}, largest {seconds.max():.2f}, first {seconds[0]:.2f}")


if __name__ == "__main__":
    main()
