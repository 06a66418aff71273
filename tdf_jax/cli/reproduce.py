"""`tdf reproduce`: the table and the figures of the paper."""

import dataclasses
from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Literal, TypeVar, get_args

import tyro
from tqdm.auto import tqdm

from tdf_jax._internal.errors import InputError
from tdf_jax._internal.files import replace_file
from tdf_jax.cli.pictures import Pictures
from tdf_jax.networks.checkpoint import load_model
from tdf_jax.paper import energy_maps, figures, table
from tdf_jax.paper.runs import Run
from tdf_jax.paper.setting import Setting, scene
from tdf_jax.paper.store import Store

Experiment = Literal["table1", "fig1", "fig2", "fig3", "fig4", "fig5", "all"]
EXPERIMENTS = get_args(Experiment)[:-1]
# Settings that an experiment chooses itself. "all" chooses all of them.
CHOSEN = {
    "table1": ("trajectory", "displacement"),
    "fig1": (),
    "fig2": ("trajectory", "displacement", "displaced", "distance"),
    "fig3": ("trajectory", "distance"),
    "fig4": ("trajectory", "displacement"),
    "fig5": ("trajectory",),
}
RUNS = "runs"  # folder of computed runs
GRID, FAST_GRID = 101, 31
FAST = {"num_starts": 2, "iterations": 60, "queries": 24}


def reproduce(
    experiment: Annotated[Experiment, tyro.conf.Positional],
    out: Annotated[Path, tyro.conf.arg(metavar="DIR")] = Path("reproduction"),
    fast: bool = False,
    weights: Annotated[str, tyro.conf.arg(metavar="NAME|FILE")] = "mug",
    setting: Annotated[Setting, tyro.conf.arg(name="")] = Setting(),
) -> None:
    """Regenerate the table and figures of the paper with generated mugs; docs/results/paper.md explains the numbers.

    A run that was interrupted computes only what is missing.

    Args:
        experiment: table or figure of the paper, or all.
        out: folder for the pictures and tables; its folder runs keeps the computed runs.
        fast: use fewer seeds and grid points, and, unless they are set, fewer starts, iterations and query points; all
            experiments then take minutes.
        weights: a name of shipped weights, or a .safetensors file.
        setting: settings that all experiments share; each experiment changes some of them.
    """
    names = EXPERIMENTS if experiment == "all" else (experiment,)
    for name in dict.fromkeys(field for one in names for field in CHOSEN[one]):
        if getattr(setting, name) != getattr(Setting(), name):
            flag = name.replace("_", "-")
            raise InputError(f"tdf reproduce: --{flag} is set, but {experiment} chooses it itself; drop it")
    if fast:
        untouched = {name: value for name, value in FAST.items() if getattr(setting, name) == getattr(Setting(), name)}
        setting = dataclasses.replace(setting, **untouched)
    model = load_model(weights)
    try:
        (out / RUNS).mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(f"tdf reproduce: cannot make the folder {out} ({error}); expected a writable place") from None
    store, pictures = Store(model, out / RUNS), Pictures("tdf reproduce")
    for name in names:
        _COMMANDS[name](store, setting, fast, out, pictures)
    pictures.check()


def _table1(store: Store, base: Setting, fast: bool, out: Path, pictures: Pictures) -> None:
    plan = table.planned(base, 1, table.FAST_VARIATIONS) if fast else table.planned(base)
    settings = [setting for _, chosen in plan for setting in chosen]
    _run_all(store, dict(enumerate(settings)), "table 1")
    rows = table.rows(store.run, plan)
    for path, content in (
        (out / "table1.md", table.as_markdown(rows)),
        (out / "table1.csv", table.as_csv(rows)),
    ):
        replace_file("tdf reproduce", path, content.encode())
        print(f"saved {path}")


def _fig1(store: Store, base: Setting, fast: bool, out: Path, pictures: Pictures) -> None:
    settings = figures.figure1(base)
    runs = _run_all(store, settings, "figure 1")
    _draw(pictures, out / "fig1.png", lambda paper: paper.figure1(runs, scene(settings["l_t"])))


def _fig2(store: Store, base: Setting, fast: bool, out: Path, pictures: Pictures) -> None:
    count = FAST_GRID if fast else GRID
    fields = {
        name: store.landscapes(base, name, count) for name in tqdm(energy_maps.FIELDS, desc="figure 2", unit="field")
    }
    _draw(pictures, out / "fig2.png", lambda paper: paper.figure2({"test mug": fields["test mug"]}))
    _draw(pictures, out / "fig2_mugs_and_poses.png", lambda paper: paper.figure2(fields))


def _fig3(store: Store, base: Setting, fast: bool, out: Path, pictures: Pictures) -> None:
    settings = figures.figure3(base, (0.25, *figures.PAPER_DISTANCES), 1) if fast else figures.figure3(base)
    runs = _run_all(store, settings, "figure 3")
    _draw(pictures, out / "fig3.png", lambda paper: paper.figure3(runs))


def _fig4(store: Store, base: Setting, fast: bool, out: Path, pictures: Pictures) -> None:
    settings = figures.figure4(base)
    runs = _run_all(store, settings, "figure 4")
    _draw(
        pictures,
        out / "fig4.png",
        lambda paper: paper.figure4(runs, {name: scene(setting) for name, setting in settings.items()}),
    )
    _draw(pictures, out / "fig4_turn.png", lambda paper: paper.figure4_turn(runs))


def _fig5(store: Store, base: Setting, fast: bool, out: Path, pictures: Pictures) -> None:
    runs = _run_all(store, figures.figure5(base), "figure 5")
    _draw(pictures, out / "fig5.png", lambda paper: paper.figure5(runs))


_COMMANDS: dict[str, Callable] = dict(zip(EXPERIMENTS, (_table1, _fig1, _fig2, _fig3, _fig4, _fig5)))


Key = TypeVar("Key")


def _run_all(store: Store, settings: dict[Key, Setting], words: str) -> dict[Key, Run]:
    """Runs of settings by the same keys, with a progress bar."""
    with tqdm(total=len(settings), desc=words, unit="run") as bar:

        def run(setting):
            result = store.run(setting)
            bar.update()
            return result

        return figures.collected(run, settings)


def _draw(pictures: Pictures, path: Path, figure: Callable) -> None:
    """Draw one picture.

    Args:
        pictures: the pictures of the command.
        path: .png file.
        figure: makes the figure; its argument is the module of the paper's figures.
    """
    with pictures.drawing(path):
        from tdf_jax.viz import paper
        from tdf_jax.viz.style import save_figure

        save_figure(path, figure(paper))
        print(f"saved {path}")
