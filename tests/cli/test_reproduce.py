"""`tdf reproduce` and the pictures it draws: the numbers of the experiments are what the axes show."""

import dataclasses

import matplotlib
import numpy as np
import pytest
from conftest import POINTS, POSES, QUERIES, STARTS, random_poses

import tdf_jax as tdf
from tdf_jax.cli import reproduce as command
from tdf_jax.cli.main import main
from tdf_jax.paper import figures, setting as settings, table
from tdf_jax.paper.energy_maps import Swept
from tdf_jax.paper.runs import Run
from tdf_jax.paper.setting import Setting
from tdf_jax.viz import paper as pictures

TINY = Setting(num_poses=POSES, iterations=2, queries=QUERIES, num_starts=STARTS)
WORDS = ("--num-poses", str(POSES), "--iterations", "2", "--queries", str(QUERIES), "--num-starts", str(STARTS))


@pytest.fixture(scope="module", autouse=True)
def small():
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(settings, "POINTS", POINTS)
        patch.setattr(command, "FAST", {})
        patch.setattr("tdf_jax.viz.style.DPI", 30)
        patch.setattr(command, "FAST_GRID", 4)
        patch.setattr(table, "FAST_VARIATIONS", ("k = 0", "l_p for l_c, infinity"))
        yield


@pytest.fixture(scope="module")
def weights(small_model, tmp_path_factory):
    path = tmp_path_factory.mktemp("weights") / "small.safetensors"
    tdf.save_model(dataclasses.replace(small_model, info=tdf.ModelInfo("small", "a test", cloud_points=40)), path)
    return str(path)


@pytest.fixture(scope="module")
def scene(small):
    return settings.scene(TINY)


def made(seed, poses=3, best=1):
    """A run of random numbers, two starts."""
    paths = [random_poses(seed + k, poses, reach=0.3) for k in range(6)]
    losses = np.array([[4.0, 3.0, 2.0], [5.0, 2.5, 1.0]])[:: 1 if best else -1] * (1 + seed)
    return Run(
        paths[0],
        paths[1],
        paths[1][:, 4:],
        np.stack(paths[2:4]),
        np.stack(paths[4:6]),
        losses,
        np.zeros(2),
        np.array(0.0),
    )


def path_of(axes, label):
    (line,) = [line for line in axes.lines if line.get_label() == label]
    return np.column_stack(line.get_data_3d()) / 100


def test_figure_1_shows_the_reference_a_start_and_both_results(scene):
    runs = {"l_t": made(0, best=0), "l_t + l_c": made(10)}  # of one start, though l_t alone takes another furthest
    figure = pictures.figure1(runs, scene)
    *panels, bar = figure.axes
    assert [axes.get_title() for axes in panels] == [
        "reference",
        "random start",
        r"after $l_t$ alone",
        r"after $l_t + k\,l_c$",
    ]
    shown = [
        np.asarray(scene.demonstration.trajectory.wxyz_xyz),
        runs["l_t + l_c"].initial_trajectories[1],
        runs["l_t"].trajectories[1],
        runs["l_t + l_c"].trajectories[1],
    ]
    for axes, path in zip(panels, shown):
        np.testing.assert_allclose(path_of(axes, "trajectory of the query frame"), path[:, 4:], atol=1e-6)
    for axes in panels[2:]:
        np.testing.assert_allclose(
            path_of(axes, "true trajectory and pick"), runs["l_t + l_c"].expected[:, 4:], atol=1e-6
        )


def test_figure_4_shows_test_reference_and_truth_of_six_runs(scene):
    wanted = figures.figure4(TINY)
    runs = {name: made(3 * index) for index, name in enumerate(wanted)}
    *panels, bar = pictures.figure4(runs, dict.fromkeys(wanted, scene)).axes
    assert len(panels) == 6
    for axes, (name, run) in zip(panels, runs.items()):
        assert axes.get_title().startswith(name[0]) and ("0.3" in axes.get_title()) == any(name[1])
        np.testing.assert_allclose(
            path_of(axes, "trajectory of the query frame"), run.trajectories[1][:, 4:], atol=1e-6
        )
        np.testing.assert_allclose(path_of(axes, "true trajectory and pick"), run.expected[:, 4:], atol=1e-6)
        reference = np.asarray(scene.demonstration.trajectory.translations)
        np.testing.assert_allclose(path_of(axes, "reference trajectory"), reference, atol=1e-6)


def test_the_turn_is_drawn_for_every_shape_beside_the_even_one():
    runs = {name: made(3 * index) for index, name in enumerate(figures.figure4(TINY))}
    first, second = pictures.figure4_turn(runs).axes
    for axes, displacement in ((first, (0.0, 0.0, 0.0)), (second, figures.DISPLACED)):
        drawn = {line.get_label(): line.get_ydata() for line in axes.lines}
        assert set(drawn) == {"line", "semicircle", "wave", "even rotation to the goal"}
        run = runs["wave", displacement]
        np.testing.assert_allclose(drawn["wave"], figures.turned(run.trajectory, run.reference))


def test_figure_5_shows_the_best_start_and_the_range_over_starts():
    runs = {"line": made(0), "wave": made(1)}
    (axes,) = pictures.figure5(runs).axes
    for line, (shape, run) in zip(axes.lines, runs.items(), strict=True):
        assert line.get_label() == shape
        np.testing.assert_array_equal(line.get_ydata(), run.losses[1])
    band = axes.collections[0].get_paths()[0].vertices
    assert (band[:, 1].min(), band[:, 1].max()) == (1.0, 5.0)


def test_figure_3_shows_errors_against_distance_and_marks_the_papers():
    runs = {
        (k, distance, 0): made(index)
        for index, (k, distance) in enumerate([(0.02, 0.5), (0.02, 2.0), (0.0, 0.5), (0.0, 2.0)])
    }
    panels = pictures.figure3(runs).axes
    values = [
        lambda run: 100 * run.pick_error[0],
        lambda run: np.degrees(run.pick_error[1]),
        lambda run: 100 * run.waypoint_error[0],
    ]
    for axes, value in zip(panels, values, strict=True):
        drawn = {line.get_label(): line for line in axes.lines if line.get_label().startswith("k")}
        for k in (0.02, 0.0):
            np.testing.assert_allclose(drawn[f"k = {k:g}"].get_xdata(), [0.5, 2.0])
            np.testing.assert_allclose(drawn[f"k = {k:g}"].get_ydata(), [value(runs[k, d, 0]) for d in (0.5, 2.0)])
        marks = [line.get_xdata()[0] for line in axes.lines if line.get_label() == "the paper's distances"]
        assert marks == [0.5, 1.0, 2.0]


def test_figure_2_shows_energies_the_way_round_they_are_with_all_marks():
    rng = np.random.default_rng(0)
    x = np.linspace(-1.2, 1.2, 5)
    energies = rng.uniform(0, 0.01, (5, 5))
    energies[4, 0] = 0.02  # at x = 1.2, y = -1.2: the lower right
    panel = Swept(x, x, energies, *rng.normal(size=(3, 3, 2)), rng.normal(size=(10, 2)))
    figure = pictures.figure2({"mug": {"line": panel, "wave": panel}})
    first, second, bar = figure.axes
    assert (first.get_title(), second.get_title()) == ("line", "wave")
    assert first.get_aspect() == 1
    (mesh,) = [one for one in first.collections if isinstance(one, matplotlib.collections.QuadMesh)]
    row, column = np.unravel_index(np.argmax(mesh.get_array()), (5, 5))
    assert (row, column) == (0, 4)  # y is the mesh's first axis
    drawn = {line.get_label(): np.column_stack(line.get_data()) for line in first.lines}
    np.testing.assert_array_equal(drawn["demonstration"], panel.path)
    np.testing.assert_array_equal(drawn["rotated with the mug"], panel.carried)
    np.testing.assert_array_equal(drawn[r"minimisers $x_i^*$"], panel.minimisers)
    np.testing.assert_array_equal(drawn["start"], panel.path[:1])
    np.testing.assert_array_equal(drawn["end"], panel.path[-1:])


# ---- the command ----


@pytest.fixture(scope="module")
def everything(weights, tmp_path_factory):
    out = tmp_path_factory.mktemp("reproduction") / "out"
    main(["reproduce", "all", "--fast", "--out", str(out), "--weights", weights, *WORDS])
    return out


@pytest.mark.slow
def test_all_writes_the_table_and_every_figure(everything):
    pictures_ = {"fig1.png", "fig2.png", "fig2_mugs_and_poses.png", "fig3.png", "fig4.png", "fig4_turn.png", "fig5.png"}
    assert {path.name for path in everything.iterdir()} == pictures_ | {"table1.md", "table1.csv", "runs"}
    for name in pictures_:
        assert (everything / name).read_bytes().startswith(b"\x89PNG")
    assert (everything / "table1.csv").read_text().count("\n") == 1 + 9 + 2 * 3


def again(name, out, weights, monkeypatch):
    """Draw a figure that is there already."""
    for computed in ("imitation", "figure2"):
        monkeypatch.setattr(f"tdf_jax.paper.store.{computed}", lambda *_: pytest.fail("computed again"))
    (out / f"{name}.png").unlink()
    main(["reproduce", name, "--fast", "--out", str(out), "--weights", weights, *WORDS])
    assert (out / f"{name}.png").read_bytes().startswith(b"\x89PNG")


@pytest.mark.slow
def test_another_experiment_that_shares_a_run_goes_on_from_it(everything, weights, monkeypatch, capsys):
    before = sorted(path.name for path in (everything / "runs").iterdir())
    again("fig5", everything, weights, monkeypatch)
    assert sorted(path.name for path in (everything / "runs").iterdir()) == before
    assert "fig5.png" in capsys.readouterr().out


def test_one_figure_is_drawn_and_a_second_call_computes_nothing(weights, tmp_path, monkeypatch):
    out = tmp_path / "out"
    main(["reproduce", "fig1", "--fast", "--out", str(out), "--weights", weights, *WORDS])
    assert {path.name for path in out.iterdir()} == {"fig1.png", "runs"}
    again("fig1", out, weights, monkeypatch)


@pytest.mark.slow
def test_one_parameter_can_be_changed(weights, tmp_path):
    main(
        [
            "reproduce",
            "fig1",
            "--out",
            str(tmp_path / "out"),
            "--weights",
            weights,
            *WORDS,
            "--pose-norm",
            "mean_absolute",
        ]
    )
    assert {path.name for path in (tmp_path / "out").iterdir()} == {"fig1.png", "runs"}


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (("fig1", "--poses", "1"), "poses is 1"),
        (("fig1", "--weights", "cup"), "cup"),
        (("fig6",), "fig6"),
        (("fig5", "--trajectory", "line"), "--trajectory is set, but fig5 chooses it itself"),
        (("all", "--distance", "1"), "--distance is set, but all chooses it itself"),
        (("fig1", "--seed", "99999999999999999999"), "seed is 99999999999999999999"),
    ],
)
def test_mistakes_are_named(words, message, tmp_path, capsys):
    with pytest.raises(SystemExit) as stop:
        main(["reproduce", *words, "--out", str(tmp_path / "out")])
    assert stop.value.code == 2
    assert message in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


def test_a_folder_that_cannot_be_made_is_named(tmp_path, capsys):
    (tmp_path / "file").write_text("x")
    with pytest.raises(SystemExit) as stop:
        main(["reproduce", "fig1", "--out", str(tmp_path / "file" / "out")])
    assert stop.value.code == 2
    assert "cannot make the folder" in capsys.readouterr().err
