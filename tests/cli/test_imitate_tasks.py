"""`tdf imitate --task`: generated objects and targets, what is judged, and what contradicts a task."""

import dataclasses
import json
import typing
from pathlib import Path

import jax.numpy as jnp
import numpy as np
import pytest

import tdf_jax as tdf
from tdf_jax._internal.errors import InputError
from tdf_jax.cli.main import main
from tdf_jax.cli.options import Settings, resolved
from tdf_jax.cli.tasks import make_task
from tdf_jax.evaluation.relation_tasks import RELATIONS
from tdf_jax.geometry import se3
from tdf_jax.shapes import FAMILIES

TASK = "bottle_in_container"
JUDGED = ("gap", "penetration", "tilt", "hung", "supported", "success")


@pytest.fixture
def shipped(monkeypatch):
    """Weights of every category are shipped."""
    monkeypatch.setattr("tdf_jax.cli.options.available_models", lambda: tuple(FAMILIES))


def settings(target, **changes):
    return resolved(Settings(task=TASK, target=Path(target), points=60, weights="w", **changes))


@pytest.fixture(scope="module", params=["found", "known"])
def made(request):
    weights = {"found": {"target_weights": "w"}, "known": {}}[request.param]
    return make_task(settings(request.param, **weights))


def moved(T, points):
    return points @ T[:3, :3].T + T[:3, 3]


def pose(T):
    return np.asarray(se3.pose(jnp.asarray(T[:3, :3]), jnp.asarray(T[:3, 3])))


def test_every_task_can_be_named():
    annotation = typing.get_type_hints(Settings)["task"]
    (choices,) = (typing.get_args(one) for one in typing.get_args(annotation) if one is not type(None))
    assert choices == tuple(RELATIONS)


def test_defaults_of_a_task(shipped):
    one = resolved(Settings(task="mug_on_rack"))
    assert (str(one.target), one.category, one.weights, one.target_weights) == ("found", "mug", "mug", "rack")
    assert one.target_pose == "random"
    # a target that has not moved is seated on by its weights too, where there are some
    assert resolved(Settings(task="mug_on_rack", target=Path("known"))).target_weights == "rack"


@pytest.mark.parametrize(("words", "message"), [
    (("--target", "mug.ply"), "--target is mug.ply and --task is bowl_on_mug; expected --target known or found"),
    (("--demonstration", "demo.npz"), "--demonstration is demo.npz and --task is bowl_on_mug; expected one of the two"),
    (("--target-object", "mug.ply"), "--target-object is mug.ply and --task"),
    (("--category", "bowl"), "--category is bowl and --task"),
    (("--trajectory", "line"), "--trajectory is line and --task"),
    (("--num-poses", "7"), "--num-poses is 7 and --task"),
    (("--queries", "64"), "--queries is 64 and --task"),
    (("--method", "adam"), "--method is adam and --task is bowl_on_mug; expected carry"),
    (("--method", "gauss-newton", "--k", "0.1"), "--method is gauss-newton and --task"),
    (("--goal-offset", "0", "0", "0.1"), "--goal-offset is (0.0, 0.0, 0.1) and --task"),
    (("--scale", "0.01"), "--scale is for a file"),
    (("--drop-invalid",), "--drop-invalid is for a file"),
    (("--k", "0.02"), "--k is a weight of eq. 3"),
    (("--iterations", "5"), "--iterations is for --method adam"),
    (("--num-starts", "0"), "--num-starts is 0"),
    (("--seed", "-1"), "--seed is -1"),
])  # fmt: skip
def test_what_contradicts_a_task(monkeypatch, tmp_path, capsys, words, message):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("tdf_jax.cli.imitate.load_model", lambda name: pytest.fail("the work has begun"))
    with pytest.raises(SystemExit) as stop:
        main(["imitate", "--task", "bowl_on_mug", *words])
    assert stop.value.code == 2 and not list(tmp_path.iterdir())
    assert f"tdf: error: tdf imitate: {message}" in capsys.readouterr().err


@pytest.mark.parametrize(("task", "needed", "option"), [
    ("mug_on_rack", "rack", "--target-weights"),
    ("bowl_on_mug", "bowl", "--weights"),
])  # fmt: skip
def test_missing_weights_name_the_option(monkeypatch, task, needed, option):
    monkeypatch.setattr("tdf_jax.cli.options.available_models", lambda: ("mug",))
    message = rf"--task {task} needs weights of a {needed}, and none .*\(shipped are mug\); give {option} FILE"
    with pytest.raises(InputError, match=message):
        resolved(Settings(task=task))
    known = Settings(task=task, target=Path("known"), weights="my.safetensors")
    assert resolved(known).target_weights == ("mug" if task == "bowl_on_mug" else None)
    given = resolved(Settings(task=task, weights="my.safetensors", target_weights="other.safetensors"))
    assert (given.weights, given.target_weights) == ("my.safetensors", "other.safetensors")


@pytest.mark.slow
def test_the_new_pair_is_another_and_the_true_motion_is_a_success(made):
    scene, placement, known = made.scene, made.placement, made.target_points is None
    shown = scene.demonstration.target.points
    assert (np.shape(placement.target_points) == np.shape(shown)) and scene.points.shape == (60, 3)
    assert np.array_equal(placement.target_points, shown) == known
    for one, T, cloud in (
        (placement.pair.object, placement.T_world_object, scene.points),
        (placement.pair.target, placement.T_world_target, placement.target_points),
    ):
        inside = moved(np.linalg.inv(T), cloud)
        assert (inside >= one.mesh.bounds[0] - 1e-6).all() and (inside <= one.mesh.bounds[1] + 1e-6).all()
    np.testing.assert_allclose(scene.T_world_places[1], placement.T_world_object @ placement.pair.object.frames["neck"])
    record = made.judged(jnp.asarray(pose(placement.motion)))
    assert record["success"] and record["supported"] and record["gap"] < 5e-4 and record["tilt"] < 0.1
    lifted = placement.motion.copy()
    lifted[:3, 3] += placement.T_world_target[:3, 2] * 0.01
    record = made.judged(jnp.asarray(pose(lifted)))
    assert not record["success"] and 0.005 < record["gap"] < 0.0105  # to the floor, or to a nearer wall


def test_given_poses_are_upright():
    made = make_task(settings("found", target_pose="given", target_weights="w"))
    for T in (made.placement.T_world_object, made.placement.T_world_target):
        np.testing.assert_allclose(T[:3, 2], [0, 0, 1], atol=1e-12)


@pytest.mark.slow
def test_without_libigl_nothing_is_judged(made, monkeypatch):
    def missing(_):
        raise InputError("libigl is missing")

    monkeypatch.setattr("tdf_jax.cli.tasks.libigl", missing)
    assert made.judged(jnp.asarray(pose(made.placement.motion))) == dict.fromkeys(JUDGED)


def perfect(made):
    """A result that picks and places as the truth."""
    pick = made.scene.T_world_places[1]
    poses = [pick, made.placement.motion @ pick]
    contact = made.placement.T_world_target @ made.placement.pair.T_target_contact
    return tdf.Result(
        trajectories=np.stack([pose(T) for T in poses])[None].astype(np.float32),
        energies=np.array([0.003], np.float32),
        candidate_history=np.array([[0.002, 0.001]], np.float32),
        initial_trajectories=np.zeros((1, 2, 7), np.float32),
        history=np.zeros((1, 2), np.float32),
        target_trajectories=pose(contact)[None, None].astype(np.float32),
        seatings=np.full((1, 3), np.nan, np.float32),
    )


@pytest.mark.slow
def test_the_record_and_the_table_judge_the_placement(made, weights, tmp_path, monkeypatch, capsys):
    target, solves = ("known", 2) if made.target_points is None else ("found", 3)
    result, calls = perfect(made), []

    def solved(*_, progress, config, **options):
        calls.append(options)
        progress(config.solver.num_steps, result.energies)
        return result

    monkeypatch.setattr("tdf_jax.cli.imitate.imitate_scene", solved)
    monkeypatch.setattr("tdf_jax.cli.imitate.make_task", lambda _: made)
    monkeypatch.setattr("tdf_jax.cli.imitate.describe", lambda *_, **__: None)
    words = ["imitate", "--task", TASK, "--target", target, "--weights", weights, "--out", tmp_path / "out"]
    words += ["--points", 60, "--no-plots", *(["--target-weights", weights] if target == "found" else [])]
    main([str(word) for word in words])
    out, error = capsys.readouterr()
    record = json.loads((tmp_path / "out" / "result.json").read_text())
    steps = solves * tdf.CarryConfig().solver.num_steps
    assert f"{steps}/{steps}" in error
    assert (calls[0]["target_points"] is None) == (target == "known")
    assert calls[0]["target_model"].info.name == ("container" if target == "known" else "small")
    assert record["relation"]["seating"] is None
    assert record["relation"]["success"] and set(JUDGED) <= set(record["relation"])
    assert record["expected"] is None and record["errors"]["path_metres"] is None
    assert record["errors"]["pick_metres"] < 1e-5 and record["errors"]["pick_radians"] < 1e-2
    assert record["settings"]["target"] == target
    assert "placement        success: gap 0." in out and "path error       n/a" in out


@pytest.mark.slow
@pytest.mark.parametrize("target", ["found", "known"])
def test_a_small_network_imitates_a_task(weights, tmp_path, target):
    words = ["imitate", "--task", "bowl_on_mug", "--target", target, "--weights", weights, "--out", tmp_path / "out"]
    words += ["--points", 60, "--num-starts", 8, *(["--target-weights", weights] if target == "found" else [])]
    main([str(word) for word in words])
    record = json.loads((tmp_path / "out" / "result.json").read_text())
    assert isinstance(record["relation"]["success"], bool)
    seating = record["relation"]["seating"]
    assert seating is None or len(seating) == 3
    assert record["relation"]["target_residual"] is None or target == "found"
    assert (tmp_path / "out" / "imitation.png").read_bytes().startswith(b"\x89PNG")


def test_a_judged_placement_has_these_names():
    from tdf_jax.evaluation.relation_success import Placed

    assert JUDGED == (*(field.name for field in dataclasses.fields(Placed)), "success")
