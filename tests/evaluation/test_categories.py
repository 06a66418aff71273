"""Categories beside mugs: their cases, errors, demonstrations and commands."""

import dataclasses
import json
import re
import typing

import jax
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import tdf_jax as tdf
from tdf_jax.cli import options, scenes
from tdf_jax.cli.main import main
from tdf_jax.cli.options import Settings, categories_of, resolved
from tdf_jax.evaluation.annotated_meshes import AnnotatedMesh
from tdf_jax.evaluation.cases import generated_case, mesh_case, object_of, size_of
from tdf_jax.evaluation.pick_report import _by_symmetry
from tdf_jax.evaluation.pick_transfer import place_errors, summary, tilts
from tdf_jax.geometry import se3
from tdf_jax.geometry.symmetry import FOLDS, about_z
from tdf_jax.shapes import FAMILIES
from tdf_jax.viz import contact_sheet as sheet


def run(*words):
    main([str(word) for word in words])


def pose_of(T):
    T = np.asarray(T, np.float32)
    return np.asarray(se3.pose(T[:3, :3], T[:3, 3]))


@pytest.fixture(scope="module")
def bottles():
    """A pair of each symmetry."""
    cases = (generated_case("bottle", 4, index, points=60) for index in range(100))
    by_fold = {}
    for case in cases:
        by_fold.setdefault(case.fold, case)
        if len(by_fold) == len(FOLDS):
            return by_fold
    raise AssertionError("no pair of some symmetry among a hundred")


# Cases


@pytest.mark.parametrize("category", FAMILIES)
def test_pairs_are_of_one_category_size_and_symmetry(category):
    for index in range(6):
        case = generated_case(category, 2, index, points=60)
        assert case.object_a.category == case.object_b.category == category
        assert case.object_a.fold == case.object_b.fold == case.fold
        assert case.object_a.parameters != case.object_b.parameters
        for one in (case.object_a, case.object_b):
            assert size_of(one) == pytest.approx(FAMILIES[category].size)
        first = FAMILIES[category].places[0]
        np.testing.assert_allclose(case.T_world_place_a, case.object_a.frames[first])
        np.testing.assert_allclose(case.T_world_place_b, case.T_world_b @ case.object_b.frames[first])
        assert case.instance == f"{category} {index}"


def test_objects_keep_their_own_sizes_where_it_is_asked():
    own, same = (generated_case("bowl", 2, 1, points=60, natural=natural) for natural in (True, False))
    sizes = [size_of(one) for one in (own.object_a, own.object_b)]
    assert abs(sizes[0] - sizes[1]) > 0.005
    for one, other in ((own.object_a, same.object_a), (own.object_b, same.object_b)):
        assert one.fold == other.fold
        vertices = one.mesh.vertices * (FAMILIES["bowl"].size / size_of(one))
        np.testing.assert_allclose(vertices, other.mesh.vertices, atol=1e-9)  # only the sizes differ


def test_mugs_are_compared_by_height_and_others_by_diagonal():
    assert size_of(object_of("mug", 0, 0, 0.1)) == object_of("mug", 0, 0, 0.1).parameters.height == pytest.approx(0.1)
    assert np.linalg.norm(object_of("bowl", 0, 0, 0.25).mesh.extents) == pytest.approx(0.25)


@pytest.mark.parametrize("fold", [0, 2, 4])
def test_an_object_of_a_symmetry_can_be_asked_for(fold):
    assert {object_of("bowl", 1, index, 0.2, fold).fold for index in range(4)} == {fold}


def test_a_place_of_another_category_is_refused():
    with pytest.raises(tdf.InputError, match="place of a bowl is 'handle'; expected one of rim, base, body"):
        generated_case("bowl", 0, 0, place="handle")


def test_a_real_bowl_is_demonstrated_on_one_of_its_size_and_symmetry():
    bowl = object_of("bowl", 3, 0, 0.17, fold=2)
    target = AnnotatedMesh("dish", bowl.mesh, bowl.height, bowl.frames, "bowl", 2)
    for pose in range(3):
        case = mesh_case(0, pose, target, points=60)
        assert case.object_a.category == "bowl" and case.object_a.fold == case.fold == 2
        assert size_of(case.object_a) == pytest.approx(0.17) and case.instance == "dish"


# Errors


@pytest.mark.parametrize("fold", FOLDS)
def test_errors_are_from_the_nearest_of_the_poses_that_a_symmetry_makes_equal(bottles, fold):
    case = bottles[fold]
    local = np.linalg.inv(case.T_world_b) @ case.T_world_place_b
    local[:3, 3] += [0.03, 0, 0]  # off the axis, as a rim
    case = dataclasses.replace(case, T_world_place_b=case.T_world_b @ local)
    for degrees in (0, 45, 90, 180, 200):
        distance, angle = place_errors(pose_of(case.T_world_b @ about_z(np.radians(degrees)) @ local)[None], [case])
        off = {
            0: 0,
            1: min(degrees, 360 - degrees),
            2: min(degrees % 180, 180 - degrees % 180),
            4: min(degrees % 90, 90 - degrees % 90),
        }[fold]
        assert angle[0] == pytest.approx(off, abs=0.1)
        assert distance[0] == pytest.approx(2 * 0.03 * np.sin(np.radians(off) / 2), abs=1e-5)


def test_any_peg_of_a_rack_is_right():
    """Two equal pegs by symmetry, and two unlike ones because both are true."""
    cases = [generated_case("rack", 6, index, points=60) for index in range(3, 10)]
    kinds = {(case.fold, len(case.others)) for case in cases}
    assert kinds == {(1, 0), (2, 0), (1, 1)}
    for case in cases:
        pegs = [case.T_world_b @ T for T in case.object_b.peg_frames]
        assert len(pegs) == 1 + (case.fold == 2) + len(case.others)
        for T in pegs:
            distance, angle = place_errors(pose_of(T)[None], [case])
            assert distance[0] < 1e-5 and angle[0] < 0.1
            np.testing.assert_allclose(tilts(pose_of(T)[None], [case]), [0], atol=0.1)
        high = pegs[-1] @ np.array([[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0.02], [0, 0, 0, 1]])
        np.testing.assert_allclose(place_errors(pose_of(high)[None], [case])[0], [0.02], atol=1e-5)
        turned = pegs[-1] @ about_z(np.radians(50))
        np.testing.assert_allclose(place_errors(pose_of(turned)[None], [case])[1], [50], atol=0.1)
    # Of another place there is one, whatever the pegs.
    assert all(not generated_case("rack", 6, index, points=60, place="post").others for index in range(3))


@pytest.mark.parametrize("fold", FOLDS)
def test_an_error_that_no_symmetry_makes_good_stays_whole(bottles, fold):
    """A lift and a tilt: neither is a turn about the axis."""
    case = bottles[fold]
    local = np.linalg.inv(case.T_world_b) @ case.T_world_place_b
    tilt = np.eye(4)
    tilt[:3, :3] = Rotation.from_euler("x", 15, degrees=True).as_matrix()
    tilt[:3, 3] = 0, 0, 0.02
    distance, angle = place_errors(pose_of(case.T_world_b @ local @ tilt)[None], [case])
    assert distance[0] == pytest.approx(0.02, abs=1e-5) and angle[0] == pytest.approx(15, abs=0.1)


@pytest.mark.parametrize("fold", FOLDS)
def test_a_tilt_is_what_no_turn_about_the_axis_changes(bottles, fold):
    case = bottles[fold]
    local = np.linalg.inv(case.T_world_b) @ case.T_world_place_b
    for turn in (0, 70, 180):
        for lean in (0, 25, 160):
            leaning = np.eye(4)
            leaning[:3, :3] = Rotation.from_euler("x", lean, degrees=True).as_matrix()
            found = case.T_world_b @ about_z(np.radians(turn)) @ local @ leaning
            np.testing.assert_allclose(tilts(pose_of(found)[None], [case]), [lean], atol=0.05)


# Scenes


def test_names_of_weights_and_categories_stand_for_each_other():
    assert categories_of("multi") == ("mug", "bowl", "bottle") and categories_of("bowl") == ("bowl",)
    assert categories_of(None) == categories_of("run/weights.safetensors") == ("mug",)
    for words, category, weights in (
        ({}, "mug", "mug"),
        ({"category": "bowl"}, "bowl", "bowl"),
        ({"weights": "bottle"}, "bottle", "bottle"),
        ({"category": "rack"}, "rack", "rack"),
        ({"weights": "multi"}, "mug", "multi"),
        ({"weights": "multi", "category": "bottle"}, "bottle", "multi"),
        ({"weights": "mine.safetensors", "category": "bowl"}, "bowl", "mine.safetensors"),
    ):
        settings = resolved(Settings(**words))
        assert (settings.category, settings.weights) == (category, weights)
        assert settings.trajectory == ("wave" if category == "mug" else "lift_over")


def test_commands_name_the_families():
    hint = typing.get_type_hints(Settings)["category"]
    (choices,) = (typing.get_args(one) for one in typing.get_args(hint) if one is not type(None))
    assert choices == tuple(FAMILIES)
    assert typing.get_args(options.Category) == tuple(FAMILIES)
    from tdf_jax.cli.evaluate import evaluate
    from tdf_jax.cli.shapes import shapes

    assert typing.get_type_hints(evaluate)["category"] == tuple[options.Category, ...]
    assert typing.get_type_hints(shapes)["category"] == options.Category


@pytest.mark.parametrize(
    "category", ["bowl", *(pytest.param(name, marks=pytest.mark.slow) for name in ("bottle", "rack", "container"))]
)
def test_a_scene_begins_at_the_categorys_place_and_ends_on_a_shelf(category):
    settings = resolved(Settings(category=category, queries=8, points=60, seed=3))
    made = scenes.make_scene(settings, jax.random.key(0))
    ends = np.asarray(made.demonstration.trajectory.matrices)[[0, -1]]
    np.testing.assert_allclose(ends[0], made.T_world_places[0], atol=1e-6)
    assert ends[1, 2, 3] > ends[0, 2, 3] + 0.1
    assert made.fold == generated_case(category, 3, 0).fold
    # Turned about the target's axis by its symmetry, the true pick is as right.
    turn = about_z(2 * np.pi / made.fold if made.fold else 1.0)
    to_place = np.linalg.inv(made.T_world_target) @ made.T_world_places[1]
    equal = made.T_world_target @ turn @ to_place
    pick = pose_of(equal @ np.linalg.inv(made.T_world_places[0]) @ ends[0])
    goal = np.asarray(made.demonstration.trajectory.wxyz_xyz[-1])
    expected = made.expected(goal, pick)
    np.testing.assert_allclose(
        np.asarray(expected.matrices[0]), np.asarray(tdf.Trajectory(pick[None]).matrices[0]), atol=1e-5
    )
    np.testing.assert_allclose(np.abs(expected.wxyz_xyz[-1]), np.abs(goal), atol=1e-5)


def test_a_bowl_is_imitated_by_the_command(weights, tmp_path, capsys):
    words = ("--method", "adam", "--num-starts", 3, "--iterations", 3, "--points", 60, "--num-poses", 4, "--queries", 8)
    run("imitate", "--category", "bowl", "--weights", weights, "--out", tmp_path / "out", *words)
    record = json.loads((tmp_path / "out" / "result.json").read_text())
    assert record["settings"]["category"] == "bowl" and record["settings"]["trajectory"] == "lift_over"
    assert record["recognised"] is None  # not weights that it is known for
    assert record["errors"]["pick_metres"] > 0
    assert (tmp_path / "out" / "imitation.png").read_bytes().startswith(b"\x89PNG")


# Evaluations


@pytest.fixture(scope="module")
def real(tmp_path_factory):
    """A folder of a bowl."""
    folder = tmp_path_factory.mktemp("real")
    tdf.build_bowl().mesh.export(folder / "dish.obj")
    (folder / "meshes.json").write_text(
        json.dumps({"dish.obj": {"category": "bowl", "unit": 1, "up": "+z", "symmetry": "round"}})
    )
    return folder


def test_categories_are_evaluated_one_after_the_other(weights, real, tmp_path, capsys):
    words = ("--pairs", 1, "--num-starts", 2, "--iterations", 2, "--num-poses", 1)
    run(
        "evaluate",
        "--weights",
        weights,
        "--category",
        "bowl",
        "bottle",
        *words,
        "--meshes",
        real,
        "--json",
        tmp_path / "scores.json",
        "--card",
        tmp_path / "card.md",
    )
    record = json.loads((tmp_path / "scores.json").read_text())
    assert [row["set"] for row in record["rows"]] == ["generated bowls", "real bowls", "generated bottles"]
    assert [row["errors"][0]["object"] for row in record["rows"]] == ["bowl 0", "dish", "bottle 0"]
    out = capsys.readouterr().out
    assert "generated bowls: 1 objects, 1 transfers of the rim; best of 2" in out and "1 transfers of the neck" in out
    card = (tmp_path / "card.md").read_text()
    assert "Real bowls: 1 at their own size, none seen in training, 1 transfers of the rim." in card
    assert "--category bowl bottle" in card


def test_a_summary_tells_symmetries_apart(bottles):
    cases = [bottles[0], bottles[2], bottles[0], bottles[4]]
    ious = {"iou": [0.9, 0.5, 0.7, None], "iou_refined": [0.8, 0.6, 0.8, None]}
    row = summary(
        np.array([0.001, 0.03, 0.015, 0.001]),
        np.array([1.0, 1.0, 1.0, 30.0]),
        ious,
        cases,
        tilt=np.array([1.0, 1.0, 21.0, 2.0]),
    )
    assert list(row["by_symmetry"]) == ["round", "two-fold", "four-fold"]
    assert row["by_symmetry"]["round"] == {
        "cases": 2, "iou": pytest.approx(0.8), "iou_refined": pytest.approx(0.8),
        "success_5mm_5deg": 0.5, "success_1cm_10deg": 0.5, "success_2cm_20deg": 1.0, "success_5cm_30deg": 1.0,
        "success_axis_2cm_20deg": 0.5,
    }  # fmt: skip
    assert row["by_symmetry"]["two-fold"]["success_2cm_20deg"] == 0 and row["by_symmetry"]["four-fold"]["iou"] is None
    cells = _by_symmetry(row)
    assert cells[0] == ["round", "2", "0.800", "0.800", "50 %", "50 %", "100 %", "50 %"]
    # at its place and upright, but turned
    assert cells[2] == ["four-fold", "1", "n/a", "n/a", "0 %", "0 %", "0 %", "100 %"]
    alike = summary(np.zeros(2), np.zeros(2), {"iou": [0.9, 0.9]}, [bottles[1]] * 2)
    assert list(alike["by_symmetry"]) == ["none"] and _by_symmetry(alike) == []


@pytest.mark.parametrize(("words", "message"), [
    (("--category", "bowl", "--place", "handle"), "--place is 'handle'; expected one of a bowl's: rim, base, body"),
    (("--category", "mug", "bottle", "--place", "rim"), "--place is 'rim'; expected one of a bottle's: neck, base"),
    (("--category", "spoon"), "invalid choice|spoon"),
    (("--category", "bottle", "--meshes", "REAL"), "--meshes has a bowl; expected bottle only"),
])  # fmt: skip
def test_bad_categories_are_refused_before_any_work(weights, real, capsys, words, message):
    with pytest.raises(SystemExit) as caught:
        run("evaluate", "--weights", weights, "--pairs", 1, *(real if word == "REAL" else word for word in words))
    assert caught.value.code == 2
    assert re.search(message, " ".join(re.sub("[│╭╮╰╯─]", " ", capsys.readouterr().err).split()))


def test_the_benchmark_refuses_other_categories(weights, real, tmp_path, capsys):
    with pytest.raises(SystemExit) as caught:
        run("benchmark", "--weights", weights, "--pairs", 0, "--meshes", real, "--out", tmp_path / "runs")
    assert caught.value.code == 2 and "--meshes has dish, a bowl; expected mugs" in capsys.readouterr().err


# Contact sheets


def test_a_contact_sheet_shows_generated_and_real_objects(real, tmp_path, monkeypatch):
    drawn, contact_sheet = [], sheet.contact_sheet
    monkeypatch.setattr(sheet, "contact_sheet", lambda objects: drawn.extend(objects) or contact_sheet(objects))
    run("shapes", "--category", "bowl", "--out", tmp_path / "sheet.png", "--count", 3, "--meshes", real)
    assert (tmp_path / "sheet.png").read_bytes().startswith(b"\x89PNG")
    assert [title for title, _ in drawn][-1] == "dish\nround" and len(drawn) == 4
    assert {title for title, _ in drawn[:3]} <= set(FOLDS.values())


@pytest.mark.parametrize(("words", "message"), [
    (("--count", 0), "--count is 0; expected a whole number of at least 1"),
    (("--seed", -1), "--seed is -1"),
    (("--out", "none/sheet.png"), "--out is none/sheet.png; expected a .png in an existing folder"),
    (("--out", "sheet.jpg"), "--out is sheet.jpg"),
])  # fmt: skip
def test_bad_contact_sheets_are_refused(tmp_path, capsys, words, message):
    given = dict(zip(words[::2], words[1::2]))
    options = {"--out": tmp_path / "sheet.png"} | given
    with pytest.raises(SystemExit) as caught:
        run("shapes", "--category", "mug", *(word for option in options.items() for word in option))
    assert caught.value.code == 2 and message in capsys.readouterr().err
