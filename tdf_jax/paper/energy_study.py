"""Does the solver come as far down as Adam? Energies of both on pairs of unseen mugs and on the rows of the paper's table 1.

`python -m tdf_jax.paper.energy_study` asks for 50 pairs and nine rows, about 20 s each on two cores. What is done is kept in the
file, and not done again.
"""

import argparse
import json
import sys
import time
from collections.abc import Sequence
from pathlib import Path

import jax
import numpy as np

from tdf_jax._internal.errors import InputError
from tdf_jax._internal.files import replace_file
from tdf_jax.energy.losses import EnergyWeights
from tdf_jax.energy.reference import describe
from tdf_jax.evaluation.cases import mug_case
from tdf_jax.geometry.demonstration import Demonstration
from tdf_jax.geometry.paths import SHAPES
from tdf_jax.geometry.query import box_query
from tdf_jax.networks.checkpoint import load_model
from tdf_jax.networks.encoding import encode
from tdf_jax.networks.model import Model
from tdf_jax.paper import setting as settings
from tdf_jax.paper.table import PAPER
from tdf_jax.solvers.adam import OptimizeConfig, optimize
from tdf_jax.solvers.initial import default_goal
from tdf_jax.solvers.multistart import SolveConfig, solve

QUERIES, QUERY_SIZE = 128, 0.06
PLACE = np.array([0.0, 0.3, 0.1])  # of the goal from the handle, metres
PERCENTILES = (0, 10, 50, 90, 100)


def pair_problem(model: Model, index: int):
    """Field, reference and settings of a pair of unseen mugs; pairs take turns with the paper's shapes."""
    case = mug_case(0, index)
    pick = case.T_world_place_a
    shape = list(SHAPES.values())[index % len(SHAPES)]
    path = shape(7, pick[:3, 3], pick[:3, 3] + PLACE, rotation=pick[:3, :3])
    query = box_query(jax.random.key(index), QUERIES, QUERY_SIZE)
    reference = describe(model, Demonstration(case.points_a, path, query))
    field = encode(model, case.points_b)
    return (
        field,
        reference,
        {"goal": default_goal(field, reference), "energy": EnergyWeights()},
        OptimizeConfig(),
    )


def row_problem(model: Model, index: int):
    """The same of a row of table 1."""
    shape, displacement = list(PAPER)[index]
    setting = settings.Setting(trajectory=shape, displacement=displacement, inits=10, queries=QUERIES)
    scene = settings.scene(setting)
    reference = settings.aim(setting, describe(model, scene.demonstration))
    field = encode(model, scene.points)
    return (
        field,
        reference,
        {"goal": settings.goal(setting, field, reference), "energy": setting.energy},
        setting.optimiser,
    )


def compare(model: Model, problem, seed: int) -> dict:
    """Energies and seconds, of the first problem with compiling, of Adam, ten starts and 100 steps, and of the solver, with one key."""
    field, reference, where, config = problem
    found = {}
    for name, minimise, chosen in (
        ("adam", optimize, config),
        ("solve", solve, SolveConfig(start=config.start, start_radius=config.start_radius)),
    ):
        begin = time.perf_counter()
        energy = minimise(field, reference, jax.random.key(seed), config=chosen, **where).loss
        found[name] = {"energy": energy, "seconds": time.perf_counter() - begin}
    return found


def told(found: dict[str, dict]) -> str:
    """How the ratios of energies, solver over Adam, are distributed."""
    lines = []
    for kind in ("row", "pair"):
        ratios = [
            one["solve"]["energy"] / one["adam"]["energy"] for name, one in found.items() if name.startswith(kind)
        ]
        if ratios:
            spread = ", ".join(
                f"{percent} %: {value:.4f}" for percent, value in zip(PERCENTILES, np.percentile(ratios, PERCENTILES))
            )
            lines.append(f"{len(ratios)} {kind}s, energy of solve over Adam's: mean {np.mean(ratios):.4f}; {spread}")
    return "\n".join(lines)


def main(arguments: Sequence[str] | None = None) -> int:
    """Compare what is missing in the file, and tell; 2 for a user's mistake."""
    parser = argparse.ArgumentParser(
        prog="python -m tdf_jax.paper.energy_study", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--pairs", type=int, default=50, help="how many (default: 50)")
    parser.add_argument("--first", type=int, default=0, help="number of the first pair (default: 0)")
    parser.add_argument("--rows", type=int, default=len(PAPER), help="of table 1, at most 9 (default: 9)")
    parser.add_argument("--seed", type=int, default=0, help="of the starts (default: 0)")
    parser.add_argument(
        "--out",
        type=Path,
        default=Path("runs/energies.json"),
        help="file to keep and go on with (default: runs/energies.json)",
    )
    options = parser.parse_args(arguments)
    try:
        found = json.loads(options.out.read_text()) if options.out.exists() else {}
        options.out.parent.mkdir(parents=True, exist_ok=True)
        model = load_model("mug")
        wanted = [("row", row_problem, index) for index in range(min(options.rows, len(PAPER)))]
        wanted += [("pair", pair_problem, index) for index in range(options.first, options.first + options.pairs)]
        names = [f"{kind} {index}, seed {options.seed}" for kind, _, index in wanted]
        for name, (_, make, index) in zip(names, wanted):
            if name not in found:
                found[name] = compare(model, make(model, index), options.seed)
                replace_file("energy_study", options.out, (json.dumps(found, indent=1) + "\n").encode())
                print(
                    name,
                    {method: f"{one['energy']:.5f} in {one['seconds']:.1f} s" for method, one in found[name].items()},
                    file=sys.stderr,
                )
    except (InputError, OSError, json.JSONDecodeError) as error:
        print(f"energy_study: error: {error}", file=sys.stderr)
        return 2
    print(told({name: found[name] for name in names}))
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
