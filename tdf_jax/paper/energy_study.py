"""Energies that the solver and Adam reach, on pairs of unseen mugs and on the rows of table 1.

Computed energies are kept in the file, and a second run computes only what is missing.

    python -m tdf_jax.paper.energy_study --pairs 50
"""

import argparse
import dataclasses
import functools
import json
import sys
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np

from tdf_jax._internal.errors import InputError
from tdf_jax._internal.files import replace_file
from tdf_jax.energy.losses import EnergyWeights
from tdf_jax.energy.reference import Reference, describe
from tdf_jax.evaluation.cases import QUERIES, QUERY_SIZE, mug_case, place_demonstration
from tdf_jax.evaluation.study_command import at_least
from tdf_jax.geometry.paths import SHAPES
from tdf_jax.geometry.query import box_query
from tdf_jax.networks.checkpoint import load_model
from tdf_jax.networks.encoding import encode
from tdf_jax.networks.field import DescriptorField
from tdf_jax.networks.model import Model
from tdf_jax.paper import setting as settings
from tdf_jax.paper.table import PAPER
from tdf_jax.solvers.adam import OptimizeConfig, optimize
from tdf_jax.solvers.initial import default_goal
from tdf_jax.solvers.multistart import SolveConfig, solve

GOAL = (0.0, 0.3, 0.1)  # metres from the handle
PERCENTILES = (0, 10, 50, 90, 100)


class Problem(NamedTuple):
    """An energy to minimise.

    Attributes:
        field: field of the target.
        reference: the demonstration.
        arguments: goal and energy weights, as keywords of both solvers.
        config: settings of Adam.
    """

    field: DescriptorField
    reference: Reference
    arguments: dict[str, Any]
    config: OptimizeConfig


def pair_problem(model: Model, index: int) -> Problem:
    """The problem of a pair of unseen mugs; pairs take the shapes of the paper in turn.

    Args:
        model: the network.
        index: number of the pair.
    """
    case = mug_case(0, index)
    query = box_query(jax.random.key(index), QUERIES, QUERY_SIZE)
    shape = list(SHAPES)[index % len(SHAPES)]
    reference = describe(model, place_demonstration(case, shape, 7, query, goal_offset=GOAL, bulge=None))
    field = encode(model, jax.device_put(case.points_b))
    arguments = {"goal": default_goal(field, reference), "energy": EnergyWeights()}
    return Problem(field, reference, arguments, OptimizeConfig())


def row_problem(model: Model, index: int) -> Problem:
    """The problem of a row of table 1.

    Args:
        model: the network.
        index: number of the row.
    """
    shape, displacement = list(PAPER)[index]
    setting = settings.Setting(displacement=displacement, num_starts=10, queries=QUERIES)
    setting = dataclasses.replace(setting, trajectory=shape)
    scene = settings.scene(setting)
    reference = settings.aim(setting, describe(model, scene.demonstration))
    field = encode(model, jax.device_put(scene.points))
    arguments = {"goal": settings.goal(setting, field, reference), "energy": setting.energy}
    return Problem(field, reference, arguments, setting.optimiser)


def compare(problem: Problem, seed: int) -> dict[str, dict[str, float]]:
    """Energies and seconds of Adam and of the solver with one key; those of the first problem include compilation.

    Args:
        problem: the problem.
        seed: seed of the starts.
    """
    field, reference, arguments, config = problem
    solver_config = SolveConfig(start=config.start, start_radius=config.start_radius)
    energies = {}
    for name, minimise in (
        ("adam", functools.partial(optimize, config=config)),
        ("solve", functools.partial(solve, config=solver_config)),
    ):
        begin = time.perf_counter()
        energy = float(minimise(field, reference, jax.random.key(seed), **arguments).loss)
        energies[name] = {"energy": energy, "seconds": time.perf_counter() - begin}
    return energies


def summary(energies: Mapping[str, Mapping[str, Mapping[str, float]]]) -> str:
    """Distribution of the ratios of energies, solver over Adam.

    Args:
        energies: what `compare` returns, by names that begin with "row" or "pair".
    """
    lines = []
    for kind in ("row", "pair"):
        ratios = [
            one["solve"]["energy"] / one["adam"]["energy"] for name, one in energies.items() if name.startswith(kind)
        ]
        if ratios:
            spread = ", ".join(
                f"{percent} %: {value:.4f}" for percent, value in zip(PERCENTILES, np.percentile(ratios, PERCENTILES))
            )
            lines.append(f"{len(ratios)} {kind}s, energy of solve over Adam's: mean {np.mean(ratios):.4f}; {spread}")
    return "\n".join(lines)


def main(arguments: Sequence[str] | None = None) -> int:
    """Compute the energies that the file does not have, and print the summary.

    Args:
        arguments: words of the command line; by default those of the process.

    Returns:
        0; 2 for a user's mistake.
    """
    parser = argparse.ArgumentParser(
        prog="python -m tdf_jax.paper.energy_study",
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("--pairs", type=at_least(0), default=50, help="number of pairs (default: 50)")
    parser.add_argument("--first", type=at_least(0), default=0, help="number of the first pair (default: 0)")
    parser.add_argument(
        "--rows", type=at_least(0), default=len(PAPER), help="number of rows of table 1 (default: 9, all)"
    )
    parser.add_argument("--seed", type=at_least(0), default=0, help="seed of the starts (default: 0)")
    parser.add_argument(
        "--out",
        type=Path,
        default=Path("runs/energies.json"),
        help="file that keeps the energies (default: runs/energies.json)",
    )
    options = parser.parse_args(arguments)
    try:
        energies = json.loads(options.out.read_text()) if options.out.exists() else {}
        options.out.parent.mkdir(parents=True, exist_ok=True)
        model = load_model("mug")
        wanted = [("row", row_problem, index) for index in range(min(options.rows, len(PAPER)))]
        wanted += [("pair", pair_problem, index) for index in range(options.first, options.first + options.pairs)]
        names = [f"{kind} {index}, seed {options.seed}" for kind, _, index in wanted]
        for name, (_, make, index) in zip(names, wanted):
            if name not in energies:
                energies[name] = compare(make(model, index), options.seed)
                replace_file("energy_study", options.out, (json.dumps(energies, indent=1) + "\n").encode())
                print(
                    name,
                    {
                        method: f"{one['energy']:.5f} in {one['seconds']:.1f} s"
                        for method, one in energies[name].items()
                    },
                    file=sys.stderr,
                )
    except (InputError, OSError, json.JSONDecodeError) as error:
        print(f"energy_study: error: {error}", file=sys.stderr)
        return 2
    print(summary({name: energies[name] for name in names}))
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
