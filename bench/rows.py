"""The rows of the benchmark: tasks, their sizes, and the results that must agree."""

import dataclasses
import importlib.util

import numpy as np

import tdf_jax as tdf
from bench import flops, machine, scene
from bench.measure import OURS, PEERS, Plan, Row, check, difference
from tdf_jax._internal.errors import InputError
from tdf_jax.landscape import shared_lattice

NDF_RATES = {"rotation_rate": 0.01, "translation_rate": 0.01, "final_rate": 1.0}  # NDF's Adam, 1e-2 throughout
# Bytes of one query point's graph; measured 87 and 104 kB, tuned heaps have holes.
POINT_BYTES = {"torch": 95e3, "torch_tuned": 120e3}
MEMORY_SHARE = 0.8  # usable share of the available memory
LATENTS, LOSSES, VALUES = 1e-4, 1e-3, 1e-4  # Adam's first steps depend on signs, which rounding changes
ENERGIES = 1e-4  # between programs that round differently
SAME = 1e-3, 1.0  # metres and degrees within which two picks are one
PROBED = 3  # steps from which the 100 of PyTorch as users run it are estimated: all of them would take minutes


@dataclasses.dataclass(frozen=True)
class Sizes:
    """Sizes of all rows."""

    clouds: tuple[int, ...] = (1000, 1500)
    num_starts: tuple[int, ...] = (1, 10, 64)
    poses: int = 7
    queries: int = 500
    target_starts: int = 10
    iterations: int = 100  # NDF's, which make the target
    our_iterations: int = 100
    grid: int = 11
    rotations: int = 4
    lattice: tuple[int, int, int] = (6, 6, 7)
    pitch: float = 0.012  # metres
    batch: tuple[int, int, int] = (8, 256, 1024)  # clouds, points, queries
    track_queries: int = 128
    targets: int = 16


QUICK = Sizes(
    clouds=(60,), num_starts=(2,), poses=3, queries=16, target_starts=2, iterations=4, our_iterations=60,
    grid=3, rotations=2, lattice=(2, 2, 3), batch=(2, 40, 32),
    track_queries=16, targets=2,
)  # fmt: skip


def rows(sizes: Sizes) -> list[Row]:
    """All rows."""
    found = [encoding(points) for points in sizes.clouds]
    found += [step(num_starts, sizes.poses, sizes.queries) for num_starts in sizes.num_starts]
    found += [target(sizes), target(sizes, same_rates=True), sweeping(sizes), training(sizes)]
    return [*found, tracking(sizes), batch(sizes), command()]


def select(found: list[Row], names: list[str] | None) -> list[Row]:
    """Rows by name, or all.

    Raises:
        InputError: an unknown name.
    """
    unknown = set(names or ()) - {row.name for row in found}
    if unknown:
        raise InputError(
            f"bench: --only {', '.join(sorted(unknown))}; expected some of {', '.join(row.name for row in found)}"
        )
    return [row for row in found if not names or row.name in names]


def agree(tolerances: dict[str, float]):
    """A check: every result is the first competitor's, as far as both go (some take fewer starts or steps)."""

    def checks(results):
        if not results:  # all of them failed, which the record says
            return [], {}
        (first, expected), *others = results.items()
        found = []
        for name, result in others:
            for key, tolerance in tolerances.items():
                common = tuple(slice(0, min(a, b)) for a, b in zip(np.shape(result[key]), np.shape(expected[key])))
                found.append(
                    check(
                        f"{key}, {name} and {first}", difference(result[key][common], expected[key][common]), tolerance
                    )
                )
        return found, {}

    return checks


def encoding(points: int) -> Row:
    """The latent of one cloud, whole."""
    plans = {name: Plan("encode") for name in (*PEERS, "tdf_jax")}
    sizes = {"points": points}
    title = f"encode {points} points"
    return Row(
        f"encode_{points}",
        title,
        sizes,
        lambda: {"cloud": scene.cloud(points)},
        plans,
        agree({"latent": LATENTS}),
        flops.encoder(points),
    )


def fitting(name: str, num_starts: int, poses: int, queries: int) -> int:
    """The largest number of starts, up to `num_starts`, whose graph fits into the memory that is available now."""
    return max(1, min(num_starts, int(MEMORY_SHARE * machine.available() / (POINT_BYTES[name] * poses * queries))))


def step(num_starts: int, poses: int, queries: int) -> Row:
    """Energy and gradient of all starts, and Adam's update; no pose is fixed."""
    peer_steps, our_steps = {1: (5, 20)}.get(num_starts, (2, 4) if num_starts <= 10 else (1, 2))

    def settings(steps):
        return NDF_RATES | {"steps": steps, "iterations": steps, "fix_last": False, "per": "step"}

    plans = {}
    for name in PEERS:
        fit = fitting(name, num_starts, poses, queries)
        note = "" if fit == num_starts else f"{fit} starts, the most that fit into memory; time x {num_starts}/{fit}"
        plans[name] = Plan(
            "descent",
            settings(peer_steps),
            fit,
            once=name == "torch" and num_starts > 10,
            scale=num_starts / fit,
            note=note,
        )
    plans["tdf_jax"] = Plan("descent", settings(our_steps))
    title = f"one step, {num_starts} x {poses} x {queries}"
    # The key stays "inits", so that a record is comparable with the committed baseline.
    sizes = {"inits": num_starts, "poses": poses, "queries": queries}
    work = flops.decoder_gradient(num_starts * poses * queries)
    return Row(
        f"step_{num_starts}", title, sizes, lambda: scene.imitation(num_starts, poses, queries), plans,
        agree({"losses": LOSSES}), work, most=3 if num_starts > 10 else 100,
    )  # fmt: skip


def target(sizes: Sizes, same_rates: bool = False) -> Row:
    """Time to the energy that PyTorch's best start has after its steps.

    PyTorch takes NDF's rates, or, as its expert might, those of `tdf.optimize`. Our whole calls count, with default
    settings; that they reach the target is a check in the first case, and a fact in the second.
    """
    num_starts, n, queries, iterations = sizes.target_starts, sizes.poses, sizes.queries, sizes.iterations
    default = tdf.OptimizeConfig()
    our_rates = {name: getattr(default, name) for name in NDF_RATES}
    common = {"iterations": iterations, "fix_last": True, "per": "call"}
    common |= our_rates if same_rates else NDF_RATES
    probed = min(PROBED, iterations)
    plans = {
        "torch": Plan(
            "descent",
            common | {"steps": probed},
            scale=iterations / probed,
            note=f"{probed} steps measured, time x {iterations}/{probed}",
        ),
        "torch_tuned": Plan("descent", common | {"steps": iterations}, once=True),
        "tdf_jax": Plan(
            "descent",
            common | our_rates | {"iterations": iterations if same_rates else sizes.our_iterations},
            once=same_rates,
        ),
    }
    if importlib.util.find_spec("tdf_jax.solvers.multistart"):
        plans["tdf_jax_solve"] = Plan("solving", {"fix_last": True}, once=same_rates)
    if same_rates:
        del plans["torch"]  # its steps take the same time at any rates

    def reached(results):
        found, facts = (
            ([], {})
            if same_rates
            else agree({"losses": LOSSES})({name: results[name] for name in PEERS if name in results})
        )
        energies = {name: float(np.min(result["energies"])) for name, result in results.items() if "energies" in result}
        facts |= {"energies": energies}
        if "torch_tuned" not in energies:
            return found, facts
        goal = facts["target"] = energies["torch_tuned"]
        if "tdf_jax" in results:
            below = np.flatnonzero(np.min(results["tdf_jax"]["losses"], axis=0) <= goal)
            facts["tdf_jax_steps"] = int(below[0]) if len(below) else None
        for name, energy in energies.items():
            if name in OURS and not same_rates:
                found.append(check(f"energy above the target's, {name}", energy - goal, 0.0))
        return found, facts

    one = flops.decoder_gradient(num_starts * (n - 1) * queries)
    # `solve` counts its own evaluations
    work = {name: one * plan.settings.get("iterations", 0) for name, plan in plans.items()}
    rates = "tdf_jax's rates" if same_rates else "NDF's rates"
    title = f"to the energy of {iterations} steps at {rates}, {num_starts} x {n} x {queries}"
    about = {"inits": num_starts, "poses": n, "queries": queries, "iterations": iterations}
    name = "target_rates" if same_rates else "target"
    return Row(name, title, about, lambda: scene.imitation(num_starts, n, queries), plans, reached, work, most=2)


def sweeping(sizes: Sizes) -> Row:
    """Energies of a lattice of query points over a plane in several orientations, half of them along the grid."""

    def arrays():
        return scene.sweep(sizes.grid, sizes.rotations, sizes.poses, sizes.lattice, sizes.pitch)

    settings = {"count": sizes.grid, "pitch": sizes.pitch}
    plans = {name: Plan("landscape", settings) for name in (*PEERS, "tdf_jax")}
    made = arrays()
    grid, query = scene.plane(sizes.grid, sizes.pitch, made["new"]), np.asarray(made["query"], float)
    shared = sum(
        shared_lattice.evaluations(grid, shared_lattice.layers(grid, query @ R.T))
        for R in made["rotations"].astype(float)
    )
    direct = sizes.grid**2 * len(query) * sizes.rotations
    work = dict.fromkeys(PEERS, flops.decoder(direct)) | {"tdf_jax": flops.decoder(shared)}

    def values(results):
        checks, facts = agree({"values": VALUES})(results)
        return checks, facts | {"evaluations": {"one by one": direct, "tdf_jax": shared}}

    about = {"points": sizes.grid**2, "rotations": sizes.rotations, "queries": len(query), "poses": sizes.poses}
    title = f"landscape, {about['points']} points x {about['rotations']} rotations x {about['queries']} queries x "
    title += f"{about['poses']} waypoints"
    return Row("landscape", title, about, arrays, plans, values, work)


def tracking(sizes: Sizes) -> Row:
    """The pick on an object that moved: by `tdf.track` from the last one, and anew by `tdf.carry`; after encoding."""

    def arrays():
        return scene.motion(sizes.poses, sizes.track_queries)

    plans = {"tdf_jax": Plan("picking", {"track": True}), "tdf_jax_solve": Plan("picking", {"track": False})}

    def same(results):
        picks = [np.asarray(result["pick"]) for result in results.values()]
        distances = [float(np.linalg.norm(pick[4:] - picks[0][4:])) for pick in picks]
        cosines = [min(1.0, abs(float(pick[:4] @ picks[0][:4]))) for pick in picks]
        angle = 2 * float(np.degrees(np.arccos(min(cosines))))
        found = [check("metres between the picks", max(distances), SAME[0]), check("degrees", angle, SAME[1])]
        return found, {"energies": {name: float(result["energy"]) for name, result in results.items()}}

    about = {"poses": sizes.poses, "queries": sizes.track_queries}
    title = f"pick on a moved object, tracked and anew by carry, {sizes.poses} x {sizes.track_queries}"
    return Row("track", title, about, arrays, plans, same, 0.0)


def batch(sizes: Sizes) -> Row:
    """Whole calls of `tdf.imitate_batch`: encoding, cleaning, describing, picks and warped paths.

    A call of `tdf.imitate` takes the first time over the number of targets.
    """
    targets = sizes.targets

    def arrays():
        return scene.targets(targets, sizes.poses, sizes.track_queries)

    plans = {"tdf_jax": Plan("imitating", {"chunk": 1}), "tdf_jax_solve": Plan("imitating", {"chunk": targets})}
    about = {"targets": targets, "poses": sizes.poses, "queries": sizes.track_queries}
    title = f"imitate on {targets} targets, one after the other and in one program, {sizes.poses} x "
    title += f"{sizes.track_queries}"
    return Row("batch", title, about, arrays, plans, agree({"energies": ENERGIES}), 0.0, most=2)


def command() -> Row:
    """`tdf imitate` with default options as a process: without kept programs, and from its second run on."""
    plans = {"tdf_jax": Plan("command", {"kept": False}), "tdf_jax_solve": Plan("command", {"kept": True})}
    title = "the command tdf imitate, without compiled programs on disk and with them"
    return Row("command", title, {}, dict, plans, agree({"energy": ENERGIES}), 0.0, most=3)


def training(sizes: Sizes) -> Row:
    """Steps on the weights."""
    clouds, points, queries = sizes.batch
    plans = {name: Plan("train", {"steps": 2, "rate": 1e-4}) for name in (*PEERS, "tdf_jax")}
    title = f"training step, {clouds} clouds x {points} points, {queries} queries"
    about = {"clouds": clouds, "points": points, "queries": queries}
    work = flops.training(clouds, points, queries)
    return Row(
        "train", title, about, lambda: scene.batch(clouds, points, queries), plans, agree({"losses": LOSSES}), work
    )
