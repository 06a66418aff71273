"""`tdf benchmark`: imitations of whole trajectories by the library, the paper's energy and baselines."""

import functools
import typing
from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Literal

import tyro

_NONE = "(default: none)"
_CATEGORY = "(default: those of the category)"
_ALL = "(default: all)"
_PROTOCOLS = "(default: those of the published protocols)"
_CORES = "(default: one for every core)"
PAGE, RECORD = "benchmark.md", "benchmark.json"
Task = Literal["bowl_on_mug", "mug_on_rack", "bottle_in_container", "bowl_on_shelf", "bottle_on_shelf"]
Pose = Literal["upright", "tilt60", "uniform"]
Cloud = Literal[
    "full", "views1", "views2", "views3", "views4", "points300", "points1000", "points3000", "noise", "half", "double"
]


def benchmark(
    weights: Annotated[str, tyro.conf.arg(metavar="NAME|FILE")] = "mug",
    pairs: int = 120,
    seed: int = 0,
    height: float = 0.12,
    clouds: tuple[Cloud, ...] = ("full",),
    methods: Annotated[
        tuple[str, ...] | None,
        tyro.conf.arg(metavar="[NAME [NAME ...]]", help_behavior_hint="(default: all; tdf_jax with --simulation)"),
    ] = None,
    num_starts: int = 10,
    meshes: Annotated[Path | None, tyro.conf.arg(metavar="DIR", help_behavior_hint=_NONE)] = None,
    recursive: bool = False,
    num_poses: int = 6,
    demonstrations: Annotated[tuple[int, ...], tyro.conf.arg(metavar="INT", help_behavior_hint=_NONE)] = (),
    relations: bool = False,
    simulation: bool = False,
    tasks: Annotated[
        tuple[Task, ...] | None, tyro.conf.arg(metavar="[TASK [TASK ...]]", help_behavior_hint=_ALL)
    ] = None,
    pose: Annotated[
        tuple[Pose, ...] | None,
        tyro.conf.arg(
            metavar="[POSE [POSE ...]]", help_behavior_hint="(default: all; upright and tilt60 with --simulation)"
        ),
    ] = None,
    modes: tuple[Literal["teleport", "execute"], ...] = ("teleport", "execute"),
    targets: Annotated[
        tuple[Literal["known", "found"], ...] | None,
        tyro.conf.arg(metavar="[TARGET [TARGET ...]]", help_behavior_hint=_PROTOCOLS),
    ] = None,
    masks: tuple[Literal["segmented", "simulator"], ...] = ("segmented",),
    episodes: int = 100,
    light: bool = False,
    processes: Annotated[int | None, tyro.conf.arg(metavar="INT", help_behavior_hint=_CORES)] = None,
    page: bool = False,
    playbacks: bool = True,
    object_weights: Annotated[str | None, tyro.conf.arg(metavar="NAME|FILE", help_behavior_hint=_CATEGORY)] = None,
    target_weights: Annotated[str | None, tyro.conf.arg(metavar="NAME|FILE", help_behavior_hint=_CATEGORY)] = None,
    out: Annotated[Path, tyro.conf.arg(metavar="DIR")] = Path("benchmark"),
) -> None:
    """Imitate whole trajectories on unseen mugs, and measure every method against the ground truth.

    With --relations, place objects on unseen targets instead, and judge the placements. With --simulation, run rows of
    episodes in physics as `tdf simulate` does. Writes benchmark.md, benchmark.json and pictures; or relations.md and
    relations.json; or simulation.md and simulation/simulation.json. A run that was interrupted, or that is repeated
    with more pairs, episodes, clouds or methods, computes only what is missing.

    Args:
        weights: a name of shipped weights, or a .safetensors file.
        pairs: number of tasks on generated pairs of mugs; 24 tasks cover every path with every goal; 0 for none, with
            --meshes.
        seed: seed of the mugs, poses, goals, query points and starts.
        height: height of generated mugs, metres.
        clouds: conditions of the new object's cloud; see docs/guide/evaluation.md; with --simulation full, views3 and
            views1.
        methods: names of methods as on the page, or all.
        num_starts: number of random starts of Adam and ICP; the library's own solver takes 64 coarse ones.
        meshes: folder of real mugs with a meshes.json; see docs/guide/evaluation.md.
        recursive: use the meshes in subfolders of that folder too.
        num_poses: number of random poses of each real mug, with --simulation of episodes of each real object.
        demonstrations: numbers of demonstrations, such as 1 3 5 10, for picks from several demonstrations; with
            --relations 1 (by default), 10, or both.
        relations: place one object on another, as in Relational NDF; of the options above, only --pairs, --seed,
            --clouds, --methods and --demonstrations apply.
        simulation: run a robot in physics, and write the rates beside published ones; needs the extra "sim"; of the
            options above, only --seed, --clouds, --methods, --demonstrations, --meshes, --recursive and --num-poses
            apply; meshes add rows of their own, of mugs, bowls and bottles.
        tasks: tasks of --relations and --simulation: bowl_on_mug, mug_on_rack and bottle_in_container, and for
            --simulation bowl_on_shelf and bottle_on_shelf.
        pose: poses of both objects of --relations, and of the object of --simulation: upright with a random yaw,
            tilt60 with roll and pitch within 60 degrees too, or uniform.
        modes: modes of --simulation: the protocol of NDF and R-NDF, and executed motions.
        targets: targets of --simulation: known where they were demonstrated, or found by their clouds.
        masks: how points of cameras of --simulation are known to be the object's; see `tdf simulate`.
        episodes: number of episodes in every row of --simulation; 0 for none, with --meshes.
        light: teleported objects of --simulation weigh 0.01 kg, as in NDF and R-NDF.
        processes: number of processes of --simulation, on which the outcomes do not depend.
        page: write pages of failures, to turn and play in a browser without a network, in the folder runs/failures:
            those that benchmark.md lists, or the first of each cause of --simulation; needs the extra "pages".
        playbacks: keep the motion of every episode of --simulation in the folder runs/episodes, 0.1 MB each, which
            `tdf view` and --page play.
        object_weights: weights of the object of --relations.
        target_weights: weights of the target of --relations.
        out: folder for the page; its folder runs keeps the computed attempts.
    """
    from tdf_jax._internal.errors import InputError
    from tdf_jax._internal.files import replace_file
    from tdf_jax.cli.attempts import attempts_folder
    from tdf_jax.cli.pictures import check_page
    from tdf_jax.evaluation.annotated_meshes import load_annotated
    from tdf_jax.evaluation.demonstration_count import count_errors
    from tdf_jax.evaluation.path_failures import failure_scene, failures, page_name
    from tdf_jax.evaluation.path_methods import METHODS
    from tdf_jax.evaluation.path_report import LISTED, page as report, record, sections
    from tdf_jax.evaluation.path_scores import run, score
    from tdf_jax.evaluation.records import folder_name, write_record
    from tdf_jax.geometry.winding import libigl
    from tdf_jax.networks.checkpoint import load_model

    if relations and simulation:
        raise InputError("tdf benchmark: --relations and --simulation are given; expected one of them; drop the other")
    plain, related, simulated = "", "--relations", "--simulation"
    _refuse_unused(
        related if relations else simulated if simulation else plain,
        {
            "--weights": (weights != "mug", (plain,)), "--height": (height != 0.12, (plain,)),
            "--num-starts": (num_starts != 10, (plain,)), "--meshes": (meshes is not None, (plain, simulated)),
            "--recursive": (recursive, (plain, simulated)), "--num-poses": (num_poses != 6, (plain, simulated)),
            "--pairs": (pairs != 120, (plain, related)),
            "--tasks": (tasks is not None, (related, simulated)), "--pose": (pose is not None, (related, simulated)),
            "--object-weights": (object_weights is not None, (related,)),
            "--target-weights": (target_weights is not None, (related,)),
            "--modes": (modes != ("teleport", "execute"), (simulated,)),
            "--targets": (targets is not None, (simulated,)), "--masks": (masks != ("segmented",), (simulated,)),
            "--episodes": (episodes != 100, (simulated,)),
            "--light": (light, (simulated,)), "--processes": (processes is not None, (simulated,)),
            "--page": (page, (plain, simulated)), "--no-playbacks": (not playbacks, (simulated,)),
        },
    )  # fmt: skip
    if simulation:
        from tdf_jax.cli.episodes import measure

        return measure(
            out,
            {
                "tasks": _given(tasks, typing.get_args(Task)), "modes": modes, "targets": targets,
                "pose": _given(pose, ("upright", "tilt60")), "clouds": clouds, "methods": _given(methods, ("tdf_jax",)),
                "demonstrations": demonstrations or (1,), "light": light, "masks": masks, "episodes": episodes,
                "seed": seed, "processes": processes, "meshes": meshes,
                "recursive": recursive, "num_poses": num_poses,
            },
            page,
            playbacks,
        )  # fmt: skip
    methods = _given(methods, ("all",))
    if relations:
        from tdf_jax.cli.pairs import measure

        settings = {
            "pairs": pairs, "seed": seed, "clouds": clouds, "methods": methods,
            "demonstrations": demonstrations or (1,), "tasks": _given(tasks, typing.get_args(Task)[:3]),
            "pose": _given(pose, typing.get_args(Pose)), "object_weights": object_weights,
            "target_weights": target_weights,
        }  # fmt: skip
        return measure(out, settings)
    _check(pairs, seed, height, clouds, methods, num_starts, meshes, num_poses, demonstrations)
    if page:
        check_page("tdf benchmark")
    names = list(METHODS) if "all" in methods else [name for name in METHODS if name in methods]
    if meshes is not None:
        libigl("tdf benchmark")
    scans = [] if meshes is None else load_annotated(meshes, recursive)
    for target in scans:
        if target.category != "mug":
            raise InputError(
                f"tdf benchmark: --meshes has {target.name}, a {target.category}; expected mugs; tdf evaluate measures "
                "other objects"
            )
    model = load_model(weights)
    folder = attempts_folder("tdf benchmark", out, PAGE, RECORD)
    makers = [
        make
        for condition in dict.fromkeys(clouds)
        for make in _makers(pairs, seed, height, condition, scans, num_poses)
    ]
    scores, scenes = [], {}
    for task, method, attempt in run(makers, model, names, folder, seed=seed, num_starts=num_starts):
        scores.append(score(method, attempt, task, model.info.name))
        if page and failures(scores[-1:]):
            scenes[page_name(scores[-1])] = failure_scene(task, attempt, model.info.name)
            listed = [page_name(one) for one in failures(scores)[:LISTED]]
            scenes = {name: scene for name, scene in scenes.items() if name in listed}  # a scan may be large
    if not scores:
        raise InputError(
            "tdf benchmark: none of --methods can run on these objects; the oracle needs generated mugs, and variants "
            "run on every fifth task"
        )
    settings = {
        "weights": weights, "pairs": pairs, "seed": seed, "height": height, "clouds": clouds, "methods": methods,
        "num_starts": num_starts, "meshes": folder_name(meshes), "recursive": recursive,
        "num_poses": num_poses, "demonstrations": demonstrations, "page": page,
    }  # fmt: skip
    picks = count_errors(makers, model, demonstrations, folder, seed=seed)
    extras = sections(scores, picks)
    write_record("tdf benchmark", out / RECORD, record(scores, model, settings, extras), indent=None)
    replace_file("tdf benchmark", out / PAGE, report(scores, model, settings, extras).encode())
    print(out / PAGE)
    _draw(out, makers, scores, extras, scenes)


def _given(values: tuple | None, default: tuple) -> tuple:
    """What an option was given, which may be nothing, or its default."""
    return default if values is None else values


def _refuse_unused(kind: str, options: dict[str, tuple[bool, tuple[str, ...]]]) -> None:
    """Refuse options of another benchmark, which would be ignored.

    Args:
        kind: what is run: "" for whole trajectories, "--relations" or "--simulation".
        options: of each option, whether it is given and the benchmarks that it is for.
    """
    from tdf_jax._internal.errors import InputError

    for flag, (given, kinds) in options.items():
        if not given or kind in kinds:
            continue
        if kind:
            raise InputError(
                f"tdf benchmark: {flag} is not for {kind}; expected one without the other; drop {flag} or {kind}"
            )
        wanted = " and ".join(kinds)
        raise InputError(
            f"tdf benchmark: {flag} is for {wanted}; expected one without the other; drop {flag}, or add "
            f"{' or '.join(kinds)}"
        )


def _makers(pairs, seed, height, clouds, targets, num_poses) -> list[Callable]:
    from tdf_jax.evaluation.cases import mesh_case, mug_case
    from tdf_jax.evaluation.path_tasks import make_task, mesh_index

    def generated(index):
        return make_task(mug_case(seed, index, height=height, clouds=clouds), seed, index)

    def real(number, pose):
        return make_task(
            mesh_case(seed, pose, targets[number], clouds=clouds), seed, mesh_index(targets[number].name, pose)
        )

    meshes = [functools.partial(real, number, pose) for number in range(len(targets)) for pose in range(num_poses)]
    return [functools.partial(generated, index) for index in range(pairs)] + meshes


def _draw(out, makers, scores, extras, scenes) -> None:
    from tdf_jax.cli.pictures import Pictures
    from tdf_jax.evaluation.path_failures import failures, page_name, page_title
    from tdf_jax.evaluation.path_methods import LIBRARY
    from tdf_jax.evaluation.path_report import FAILURES, PICTURES
    from tdf_jax.geometry.paths import PATHS

    # The first six tasks are one of each path with the goal not displaced. Later tasks with the same path are drawn
    # instead where there are some, because they show the displaced goals.
    kinds = len(PATHS)
    shown = [
        makers[index + index % 4 * kinds if index + index % 4 * kinds < len(makers) else index]
        for index in range(min(kinds, len(makers)))
    ]
    first = scores[0].clouds

    def figure(name):
        from tdf_jax.viz import evaluation

        if name == "truth":
            return evaluation.truth_figure([make() for make in shown])
        if name == "errors":
            return evaluation.errors_figure([one for one in scores if one.clouds == first], LIBRARY)
        if name == "reliability":
            return evaluation.reliability_figure(scores, extras["reliability"]["bins"])
        return evaluation.demonstrations_figure(extras["demonstrations"])

    pictures = Pictures("tdf benchmark")
    for name in ("truth", "errors", *(name for name in ("reliability", "demonstrations") if name in extras)):
        with pictures.drawing(out / PICTURES[name]) as path:
            from tdf_jax.viz.style import save_figure

            save_figure(path, figure(name))
    for one in (one for one in failures(scores) if page_name(one) in scenes):
        with pictures.drawing(out / FAILURES / page_name(one)) as path:
            from tdf_jax.viz.imitation_page import save_imitation_page

            path.parent.mkdir(exist_ok=True)
            save_imitation_page(path, scenes[page_name(one)], page_title(one))
    pictures.check()


def _check(pairs, seed, height, clouds, methods, num_starts, meshes, num_poses, demonstrations) -> None:
    from tdf_jax._internal import checks
    from tdf_jax._internal.errors import InputError
    from tdf_jax.evaluation.demonstration_count import MOST
    from tdf_jax.evaluation.path_methods import METHODS

    def need(truth, what):
        if not truth:
            raise InputError(f"tdf benchmark: {what}")

    need(
        pairs >= 1 or (meshes is not None and pairs == 0),
        f"--pairs is {pairs}; expected at least 1, or 0 with --meshes",
    )
    checks.seed("tdf benchmark", seed, "--seed")
    checks.number("tdf benchmark", "--height", height, 0.01, 1, "metres")
    checks.count("tdf benchmark", "--num-starts", num_starts)
    checks.count("tdf benchmark", "--num-poses", num_poses)
    need(clouds, "--clouds is empty; expected at least one condition, such as full")
    unknown = [name for name in methods if name not in (*METHODS, "all")]
    need(
        methods and not unknown,
        f"--methods has {', '.join(map(repr, unknown)) or 'none'}; expected all, or some of "
        f"{', '.join(map(repr, METHODS))}",
    )
    for count in demonstrations:
        checks.count("tdf benchmark", "--demonstrations", count, most=MOST)
