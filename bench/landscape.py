"""Time of energy landscapes: the shared sweep of a lattice against an evaluation for each grid point and query point.

Both sweeps alternate in one run. They share each evaluation between waypoints and use the same sums. Compilation is
measured separately.

    python -m bench.landscape              # a plane
    python -m bench.landscape --volume     # and a volume, shared only
"""

import argparse
import json
import resource
import statistics
import time

import jax
import numpy as np

import tdf_jax as tdf
from bench import scene
from bench.machine import machine
from tdf_jax.landscape import shared_lattice

HALF, COUNT, PITCH, LATTICE, POSES = 0.6, 101, 0.012, (6, 6, 7), 7
VOLUME_HALF, VOLUME_COUNT = 0.3, 64


def case(pitch: float):
    """The field of a generated mug, and the reference of a wave from the handle of another.

    Args:
        pitch: distance of neighbouring query points, metres.
    """
    model = tdf.load_model("mug")
    start = scene.handle()
    path = tdf.wave(POSES, start=start, end=start + [0.0, 0.3, 0.0])
    query = tdf.lattice_query(LATTICE, pitch)
    demonstration = tdf.Demonstration(scene.surface(0, 1500), path, query)
    field = tdf.encode(model, scene.surface(1, 1500))
    return field, tdf.describe(model, demonstration), start


def timed(field, reference, grid, share):
    """Seconds of a sweep, and its energies.

    Args:
        field: the field.
        reference: the reference.
        grid: the grid.
        share: whether the sweep shares evaluations between grid points.
    """
    began = time.perf_counter()
    values = tdf.energy_landscape(field, reference, grid, share=share).values
    return time.perf_counter() - began, values


def plane(repetitions: int) -> dict:
    """The shared and the direct sweep of the plane.

    Args:
        repetitions: number of sweeps of each kind, after a first one that compiles.
    """
    field, reference, start = case(PITCH)
    grid = tdf.plane_grid(HALF, COUNT, start)
    counts = {
        share: shared_lattice.evaluations(grid, shared_lattice.layers(grid, np.asarray(reference.query), share))
        for share in (True, False)
    }
    times, values = {True: [], False: []}, {}
    first = {share: timed(field, reference, grid, share)[0] for share in (True, False)}
    for _ in range(repetitions):
        for share in (True, False):
            seconds, values[share] = timed(field, reference, grid, share)
            times[share].append(seconds)
    medians = {share: statistics.median(times[share]) for share in times}
    return {
        "points": list(grid.shape),
        "queries": len(reference.query),
        "waypoints": POSES,
        "evaluations": {
            "shared": counts[True],
            "direct": counts[False],
            "one_by_one": int(np.prod(grid.shape)) * len(reference.query),
        },
        "seconds": {
            "shared": times[True],
            "direct": times[False],
            "first": {"shared": first[True], "direct": first[False]},
        },
        "evaluations_ratio": counts[False] / counts[True],
        "time_ratio": medians[False] / medians[True],
        "largest_relative_difference": float(np.abs(values[True] / values[False] - 1).max()),
    }


def volume() -> dict:
    """The shared sweep of the volume."""
    pitch = 2 * VOLUME_HALF / (VOLUME_COUNT - 1)
    field, reference, start = case(pitch)
    grid = tdf.volume_grid(VOLUME_HALF, VOLUME_COUNT, start)
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    seconds, _ = timed(field, reference, grid, True)
    found = shared_lattice.layers(grid, np.asarray(reference.query))
    return {
        "points": list(grid.shape),
        "evaluations": shared_lattice.evaluations(grid, found),
        "one_by_one": int(np.prod(grid.shape)) * len(reference.query),
        "seconds_with_compilation": seconds,
        "peak_megabytes": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024,
        "peak_megabytes_before": before / 1024,
    }


def main() -> None:
    """Measure and print the times, as JSON with --json."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--repetitions", type=int, default=3, help="sweeps of each kind (default: 3)")
    parser.add_argument("--volume", action="store_true", help="measure the volume too")
    parser.add_argument("--json", action="store_true", help="print the record as JSON")
    options = parser.parse_args()
    record = {"machine": machine() | {"device": jax.devices()[0].device_kind}, "plane": plane(options.repetitions)}
    if options.volume:
        record["volume"] = volume()
    if options.json:
        print(json.dumps(record, indent=1))
        return
    print("machine:", ", ".join(f"{name} {value}" for name, value in record["machine"].items()))
    found = record["plane"]
    for name in ("shared", "direct"):
        spread = ", ".join(f"{seconds:.2f}" for seconds in found["seconds"][name])
        print(
            f"plane, {name}: {found['evaluations'][name]:,} evaluations, {spread} s (first call "
            f"{found['seconds']['first'][name]:.2f})"
        )
    print(
        f"plane: {found['evaluations_ratio']:.1f} x fewer evaluations, {found['time_ratio']:.1f} x less time, "
        f"energies differ by at most {found['largest_relative_difference']:.1e} of themselves"
    )
    if options.volume:
        found = record["volume"]
        print(
            f"volume: {found['evaluations']:,} evaluations (one by one {found['one_by_one']:,}), "
            f"{found['seconds_with_compilation']:.1f} s with compilation, peak {found['peak_megabytes']:.0f} MB "
            f"({found['peak_megabytes_before']:.0f} before)"
        )


if __name__ == "__main__":
    main()
