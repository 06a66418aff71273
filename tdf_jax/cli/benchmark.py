"""`tdf benchmark`: whole trajectories with known truth, by the library, the paper's energy and baselines; a page, pictures and numbers."""

import functools
import json
from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Literal

import tyro

_NONE = "(default: none)"
PAGE, RECORD, RUNS = "benchmark.md", "benchmark.json", "runs"
Cloud = Literal[
    "full", "views1", "views2", "views4", "points300", "points1000", "points3000", "noise", "half", "double"
]


def benchmark(
    weights: Annotated[str, tyro.conf.arg(metavar="NAME|FILE")] = "mug",
    pairs: int = 120,
    seed: int = 0,
    height: float = 0.12,
    clouds: tuple[Cloud, ...] = ("full",),
    methods: Annotated[tuple[str, ...], tyro.conf.arg(metavar="NAME")] = ("all",),
    inits: int = 10,
    meshes: Annotated[Path | None, tyro.conf.arg(metavar="DIR", help_behavior_hint=_NONE)] = None,
    poses: int = 6,
    demonstrations: Annotated[tuple[int, ...], tyro.conf.arg(metavar="INT", help_behavior_hint=_NONE)] = (),
    out: Annotated[Path, tyro.conf.arg(metavar="DIR")] = Path("benchmark"),
) -> None:
    """Imitate whole trajectories on unseen mugs, goals displaced up to the opposite direction, and measure every method against the truth.

    Writes benchmark.md, benchmark.json and pictures. Interrupted and run again, also with more pairs, clouds or
    methods, it does only what is missing.

    Args:
        weights: a name of shipped weights, or a .safetensors file.
        pairs: tasks on generated mug pairs; 24 are one of each path with each goal; 0 for none, beside --meshes.
        seed: of the mugs, poses, goals, query points and starts.
        height: of generated mugs, metres.
        clouds: how the new object is seen; see docs/guide/evaluation.md.
        methods: some of those on the page, by their names there, or all.
        inits: random starts of Adam and ICP; the library's own solver takes 64 cheap ones.
        meshes: folder of real mugs and their meshes.json; see docs/guide/evaluation.md.
        poses: random poses of each real mug.
        demonstrations: also measure picks learnt from so many demonstrations, such as 1 3 5 10.
        out: folder for the page; what was computed is kept in its folder runs.
    """
    from tdf_jax._internal.errors import InputError
    from tdf_jax._internal.files import replace_file
    from tdf_jax.evaluation.annotated_meshes import load_annotated
    from tdf_jax.evaluation.demonstration_count import learnt
    from tdf_jax.evaluation.methods import METHODS
    from tdf_jax.evaluation.path_page import page, record, sections
    from tdf_jax.evaluation.path_runs import run
    from tdf_jax.evaluation.path_scores import score
    from tdf_jax.geometry.winding import libigl
    from tdf_jax.networks.checkpoint import load_model

    _check(pairs, seed, height, clouds, methods, inits, meshes, poses, demonstrations)
    names = list(METHODS) if "all" in methods else [name for name in METHODS if name in methods]
    if meshes is not None:
        libigl("tdf benchmark")
    targets = [] if meshes is None else load_annotated(meshes)
    for target in targets:
        if target.category != "mug":
            raise InputError(
                f"tdf benchmark: --meshes has {target.name}, a {target.category}; expected mugs; tdf evaluate measures others"
            )
    model = load_model(weights)
    folder = _folder(out)
    makers = [
        make for condition in dict.fromkeys(clouds) for make in _makers(pairs, seed, height, condition, targets, poses)
    ]
    scores = [
        score(method, attempt, task)
        for task, method, attempt in run(makers, model, names, folder, seed=seed, inits=inits)
    ]
    if not scores:
        raise InputError(
            "tdf benchmark: none of --methods can be tried on these objects; the oracle needs generated mugs, and variants some of every fifth task"
        )
    settings = {
        "weights": weights, "pairs": pairs, "seed": seed, "height": height, "clouds": clouds, "methods": methods, "inits": inits,
        "meshes": None if meshes is None else str(meshes), "poses": poses, "demonstrations": demonstrations,
    }  # fmt: skip
    picks = learnt(makers, model, demonstrations, folder, seed=seed)
    extras = sections(scores, picks)
    _draw(out, makers, scores, extras)
    replace_file(
        "tdf benchmark",
        out / RECORD,
        (json.dumps(record(scores, model, settings, extras), allow_nan=False) + "\n").encode(),
    )
    replace_file("tdf benchmark", out / PAGE, page(scores, model, settings, extras).encode())
    print(out / PAGE)


def _makers(pairs, seed, height, clouds, targets, poses) -> list[Callable]:
    from tdf_jax.evaluation.cases import mesh_case, mug_case
    from tdf_jax.evaluation.path_tasks import make_task, mesh_index

    def generated(index):
        return make_task(mug_case(seed, index, height=height, clouds=clouds), seed, index)

    def real(number, pose):
        return make_task(
            mesh_case(seed, pose, targets[number], clouds=clouds), seed, mesh_index(targets[number].name, pose)
        )

    meshes = [functools.partial(real, number, pose) for number in range(len(targets)) for pose in range(poses)]
    return [functools.partial(generated, index) for index in range(pairs)] + meshes


def _draw(out, makers, scores, extras) -> None:
    from tdf_jax.evaluation.methods import LIBRARY
    from tdf_jax.evaluation.path_page import PICTURES
    from tdf_jax.geometry.paths import PATHS
    from tdf_jax.viz.evaluation import demonstrations_figure, errors_figure, reliability_figure, truth_figure
    from tdf_jax.viz.style import save_figure

    # The first six tasks are one of each path, not displaced; later ones show where goals go.
    kinds = len(PATHS)
    shown = [
        makers[index + index % 4 * kinds if index + index % 4 * kinds < len(makers) else index]
        for index in range(min(kinds, len(makers)))
    ]
    save_figure(out / PICTURES["truth"], truth_figure([make() for make in shown]))
    first = scores[0].clouds
    save_figure(out / PICTURES["errors"], errors_figure([one for one in scores if one.clouds == first], LIBRARY))
    if "reliability" in extras:
        save_figure(out / PICTURES["reliability"], reliability_figure(scores, extras["reliability"]["bins"]))
    if "demonstrations" in extras:
        save_figure(out / PICTURES["demonstrations"], demonstrations_figure(extras["demonstrations"]))


def _folder(out: Path) -> Path:
    """The folder of what was computed, made now: an hour of work is lost where it cannot be."""
    from tdf_jax._internal.errors import InputError

    if (out / PAGE).exists() and not (out / RECORD).exists():
        raise InputError(
            f"tdf benchmark: {out / PAGE} is not of an earlier benchmark, there is no {RECORD} beside it; expected another --out: nothing of yours is overwritten"
        )
    try:
        (out / RUNS).mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(f"tdf benchmark: cannot make the folder {out} ({error}); expected a writable place") from None
    return out / RUNS


def _check(pairs, seed, height, clouds, methods, inits, meshes, poses, demonstrations) -> None:
    from tdf_jax._internal.errors import InputError
    from tdf_jax.evaluation.demonstration_count import MOST
    from tdf_jax.evaluation.methods import METHODS

    def need(truth, what):
        if not truth:
            raise InputError(f"tdf benchmark: {what}")

    need(
        pairs >= 1 or (meshes is not None and pairs == 0),
        f"--pairs is {pairs}; expected at least 1, or 0 with --meshes",
    )
    need(0 <= seed < 2**32, f"--seed is {seed}; expected 0 to {2**32 - 1}")
    need(0.01 <= height <= 1.0, f"--height is {height}; expected metres between 0.01 and 1")
    need(inits >= 1, f"--inits is {inits}; expected at least 1")
    need(poses >= 1, f"--poses is {poses}; expected at least 1")
    need(clouds, "--clouds is empty; expected at least one condition, such as full")
    unknown = [name for name in methods if name not in (*METHODS, "all")]
    need(
        methods and not unknown,
        f"--methods has {', '.join(map(repr, unknown)) or 'none'}; expected all, or some of {', '.join(map(repr, METHODS))}",
    )
    need(
        all(1 <= count <= MOST for count in demonstrations),
        f"--demonstrations is {demonstrations}; expected numbers of 1 to {MOST}",
    )
