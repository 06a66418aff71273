"""Truth, cases and errors by hand, and the shipped weights on three pairs of unseen mugs."""

import dataclasses

import jax.numpy as jnp
import numpy as np
import pytest
from conftest import compilations
from scipy.spatial import cKDTree

import tdf_jax as tdf
from tdf_jax._internal.errors import InputError
from tdf_jax.evaluation.annotated_meshes import AnnotatedMesh
from tdf_jax.evaluation.cases import QUERY_SIZE, mesh_case, mug_case
from tdf_jax.evaluation.conditions import CONDITIONS, NOISE
from tdf_jax.evaluation.metrics import expected_trajectory, path_error, pose_error
from tdf_jax.evaluation.pick_transfer import (
    BASELINES,
    compare,
    imitated,
    overlaps,
    place_errors,
    random_weights,
    summary,
    transferred,
)
from tdf_jax.geometry import se3
from tdf_jax.geometry.sampling import sample_surface


def rigid(rotation_vector, translation):
    T = np.eye(4)
    T[:3, :3] = se3.exp(jnp.asarray(rotation_vector, jnp.float32))
    T[:3, 3] = translation
    return T


def test_the_expected_trajectory_goes_from_the_carried_pick_to_the_goal():
    shown = tdf.line(5, start=(0.05, 0, 0), end=(0.05, 0.4, 0))
    place_a, place_b = rigid([0, 0, 0], [0.05, 0, 0]), rigid([0, 0, np.pi / 2], [0.0, 0.07, 0.2])
    goal = se3.pose(jnp.eye(3), jnp.array([0.05, 0.4, 0.3]))
    expected = expected_trajectory(shown, place_a, place_b, goal)
    np.testing.assert_allclose(expected.translations[0], [0.0, 0.07, 0.2], atol=1e-6)  # the handle goes to the handle
    np.testing.assert_allclose(expected.wxyz_xyz[-1], goal, atol=1e-6)
    turns = se3.rotation_distance(expected.rotations, jnp.eye(3)[None])
    np.testing.assert_allclose(turns, np.linspace(np.pi / 2, 0, 5), atol=1e-6)
    # Half way: the mean of where the pick's motion (x, y -> -y, x + ...) and the goal's (0.3 m up) carry (0.05, 0.2,
    # 0).
    np.testing.assert_allclose(
        expected.translations[2], (np.array([-0.2, 0.07, 0.2]) + [0.05, 0.2, 0.3]) / 2, atol=1e-6
    )


def test_the_same_object_moved_is_expected_to_carry_its_trajectory():
    shown, moved = tdf.wave(6), rigid([0.3, -0.8, 0.5], [0.1, 0.2, 0.3])
    place = rigid([0, 0.4, 0], [0.05, 0, 0.02])
    carried = shown.transformed(se3.pose(jnp.asarray(moved[:3, :3]), jnp.asarray(moved[:3, 3])))
    expected = expected_trajectory(shown, place, moved @ place, carried.wxyz_xyz[-1])
    distance, angle = pose_error(expected.wxyz_xyz, carried.wxyz_xyz)
    assert distance.max() < 1e-6 and angle.max() < 1e-3
    assert path_error(expected, carried) < 1e-6
    assert path_error(expected, carried.shifted(jnp.array([0.0, 0.03, 0.04]))) == pytest.approx(0.05, abs=1e-6)


@pytest.fixture(scope="module")
def pair():
    return mug_case(3, 1, points=50)


def of_objects(case, *names):
    return [dataclasses.replace(case, instance=name) for name in names]


def test_summary_counts(pair):
    distance = np.array([0.005, 0.015, 0.03, 0.005])
    angle = np.array([5.0, 15.0, 5.0, 175.0])
    row = summary(
        distance,
        angle,
        {"iou": [0.5, None, 0.7, None], "iou_refined": [0.6, None, 0.9, None]},
        of_objects(pair, *"abcd"),
    )
    assert (row["success_5mm_5deg"], row["success_1cm_10deg"], row["success_2cm_20deg"]) == (0.25, 0.25, 0.5)
    assert row["flips"] == 1 and row["objects"] == row["cases"] == 4
    assert row["iou"] == pytest.approx(0.6) and row["iou_refined"] == pytest.approx(0.75) and row["iou_cases"] == 2
    assert row["position_median_cm"] == pytest.approx(1.0)
    diagonal = np.linalg.norm(np.ptp(pair.object_b.mesh.vertices, axis=0))
    assert row["position_median_diagonals"] == pytest.approx(0.01 / diagonal)
    assert row["position_p90_diagonals"] == pytest.approx(np.percentile(distance, 90) / diagonal)
    low, high = row["interval_2cm_20deg"]
    assert low < 0.5 < high


def test_intervals_draw_objects_and_not_poses(pair):
    """20 poses of an object that always succeeds and 20 of one that never does are two observations, not forty."""
    distance, angle = np.repeat([0.0, 1.0], 20), np.zeros(40)
    few = summary(distance, angle, {"iou": [None] * 40}, of_objects(pair, *("a" * 20 + "b" * 20)))
    assert few["interval_1cm_10deg"] == [0.0, 1.0] and few["success_1cm_10deg"] == 0.5 and few["iou"] is None
    low, high = summary(distance, angle, {"iou": [None] * 40}, of_objects(pair, *map(str, range(40))))[
        "interval_1cm_10deg"
    ]
    assert 0.3 < low < 0.4 and 0.6 < high < 0.7
    assert summary(distance, angle, {"iou": [None] * 40}, of_objects(pair, *("a" * 40)))["interval_1cm_10deg"] is None


def test_cases_are_functions_of_seed_and_index():
    first, again, other = mug_case(3, 1, points=50), mug_case(3, 1, points=50), mug_case(3, 2, points=50)
    np.testing.assert_array_equal(first.points_b, again.points_b)
    assert np.abs(first.points_b - other.points_b).max() > 1e-3
    for mug in (first.object_a, first.object_b):
        assert mug.parameters.height == pytest.approx(0.12)
    # The truth is the handle of the mug as it lies, and the cloud lies there too.
    T = first.T_world_b
    np.testing.assert_allclose(first.T_world_place_b, T @ first.object_b.handle_frame)
    back = (first.points_b - T[:3, 3]) @ T[:3, :3]
    low, high = first.object_b.mesh.bounds
    assert (back > low - 1e-5).all() and (back < high + 1e-5).all()


def test_the_cases_of_a_seed_stay_what_they_were_when_its_results_were_published():
    case = mug_case(2, 0)
    np.testing.assert_allclose(case.points_a[0], [0.0031817, 0.0329405, -0.0315905], atol=1e-6)
    np.testing.assert_allclose(case.points_b[[0, -1], 0], [-0.0116077, -0.0351995], atol=1e-6)
    np.testing.assert_allclose(case.T_world_place_b[:3, 3], [-0.0842511, -0.1302407, 0.2719565], atol=1e-6)


@pytest.mark.parametrize("clouds", CONDITIONS)
def test_conditions_change_the_new_objects_cloud_and_nothing_else(clouds):
    full, case, again = mug_case(3, 1), mug_case(3, 1, clouds=clouds), mug_case(3, 1, clouds=clouds)
    np.testing.assert_array_equal(case.points_b, again.points_b)
    assert case.clouds == clouds
    scale = {"half": 0.5, "double": 2.0}.get(clouds, 1.0)
    assert case.scale == scale
    np.testing.assert_array_equal(case.T_world_b, full.T_world_b)
    np.testing.assert_allclose(case.points_a, scale * full.points_a, atol=1e-6)
    for name in ("object_a", "object_b"):
        assert getattr(case, name).parameters.height == pytest.approx(0.12 * scale)
    local = np.linalg.inv(case.T_world_b) @ case.T_world_place_b
    np.testing.assert_allclose(local[:3, 3], scale * full.object_b.handle_frame[:3, 3], atol=1e-9)
    assert case.diagonal == pytest.approx(scale * full.diagonal)
    assert len(case.points_b) == {"points300": 300, "points1000": 1000, "points3000": 3000, "noise": 300}.get(
        clouds, 1500
    )
    dense = cKDTree(sample_surface(case.object_b.mesh, 20_000, 0))
    off, _ = dense.query((case.points_b - case.T_world_b[:3, 3]) @ case.T_world_b[:3, :3])
    assert off.max() < (0.010 if clouds == "noise" else 0.004 * scale)  # of points on it, about 1 mm


def test_noise_moves_points_by_two_millimetres_along_each_axis():
    clean, noisy = (mug_case(3, 1, clouds=clouds).points_b for clouds in ("points300", "noise"))
    np.testing.assert_allclose(np.std(noisy - clean, axis=0), NOISE, rtol=0.15)


def test_fewer_cameras_see_less():
    shares = []
    whole = mug_case(3, 1, clouds="points3000").points_b
    for clouds in ("views1", "views2", "views4"):
        case = mug_case(3, 1, clouds=clouds)
        shares.append(np.mean(cKDTree(case.points_b).query(whole)[0] < 0.005))
    assert shares[0] < 0.75 and shares[0] + 0.1 < shares[1] < shares[2]


def test_an_unknown_condition():
    with pytest.raises(InputError, match="clouds is 'foggy'; expected one of full, views1"):
        mug_case(0, 0, clouds="foggy")


def annotated(name, mug):
    return AnnotatedMesh(name, mug.mesh, mug.parameters.height, mug.frames)


def test_real_meshes_keep_their_size_and_do_not_depend_on_each_other():
    mug = mug_case(5, 0, height=0.08).object_b
    first, again = (mesh_case(1, 2, annotated("cup", mug), points=60) for _ in range(2))
    np.testing.assert_array_equal(first.points_b, again.points_b)
    assert first.instance == "cup" and first.object_a.parameters.height == pytest.approx(0.08)
    np.testing.assert_allclose(first.T_world_place_b, first.T_world_b @ mug.handle_frame)
    half = mesh_case(1, 2, annotated("cup", mug), points=60, clouds="half")
    assert half.object_a.parameters.height == pytest.approx(0.04)
    np.testing.assert_allclose(half.object_b.mesh.bounds, 0.5 * mug.mesh.bounds)
    for other in (mesh_case(1, 3, annotated("cup", mug), points=60), mesh_case(1, 2, annotated("mug", mug), points=60)):
        assert np.abs(other.T_world_b - first.T_world_b).max() > 1e-3
        assert np.abs(other.points_a - first.points_a).max() > 1e-3


def test_open_meshes_have_no_iou(small_model):
    mug = mug_case(5, 0, height=0.08).object_b
    holed = mug.mesh.copy()
    holed.update_faces(np.random.default_rng(1).random(len(holed.faces)) < 0.5)
    targets = [annotated("closed", mug), dataclasses.replace(annotated("open", mug), mesh=holed)]
    cases = [mesh_case(0, 0, target, points=40) for target in targets]
    for closed, opened in overlaps(small_model, cases, samples=200).values():
        assert 0 <= closed <= 1 and opened is None


def test_a_transfer_between_objects_of_half_the_size_is_asked_with_half_the_query(small_model, monkeypatch):
    sizes = []
    monkeypatch.setattr(
        "tdf_jax.evaluation.pick_transfer.box_query",
        lambda key, count, size: sizes.append(size) or tdf.box_query(key, 8, size),
    )
    cases = [mug_case(0, 0, points=40, clouds=clouds) for clouds in ("full", "half")]
    transferred(small_model, cases, config=tdf.OptimizeConfig(num_starts=2, iterations=1), progress=False)
    assert sizes == [QUERY_SIZE, QUERY_SIZE / 2]


@pytest.mark.slow
def test_every_case_and_network_runs_the_programs_of_the_first(small_model):
    """Clouds of any number of points are thinned to one; no later case compiles anything."""
    model = dataclasses.replace(small_model, info=tdf.ModelInfo("small", "a test", cloud_points=40))
    config = tdf.OptimizeConfig(num_starts=2, iterations=2)
    batches = [
        [mug_case(0, index, points=60, clouds=clouds)]
        for index, clouds in enumerate(("full", "half", "views1", "noise"))
    ]
    compare(batches[0], model, BASELINES, config=config, progress=False)
    with compilations() as names:
        for cases in batches[1:]:
            compare(cases, model, BASELINES, config=config, progress=False)
    assert names == []


def test_an_unknown_baseline_raises_before_anything_runs():
    with pytest.raises(
        InputError, match=r"compare\(\): baselines has 'RANSAC'; expected some of random weights, PCA, ICP"
    ):
        compare([], None, ("ICP", "RANSAC"))


@pytest.mark.slow
def test_the_shipped_weights_transfer_a_pose_and_random_ones_do_not():
    model = tdf.load_model("mug")
    cases = [mug_case(0, index) for index in range(3)]
    config = tdf.OptimizeConfig(num_starts=5, iterations=40)
    distance, angle = place_errors(transferred(model, cases, config=config, progress=False), cases)
    assert (distance < 0.02).all() and (angle < 20).all(), (distance, angle)
    encoded, refined = overlaps(model, cases[:1], samples=4000).values()
    assert encoded[0] > 0.7 and refined[0] > encoded[0] + 0.01
    distance, angle = place_errors(transferred(random_weights(model, 0), cases, config=config, progress=False), cases)
    assert ((distance > 0.02) | (angle > 20)).sum() >= 2


@pytest.mark.slow
def test_picks_of_imitate_are_those_of_the_library_and_its_confidence_is_kept():
    mug_model, case = tdf.load_model("mug"), mug_case(3, 1)
    (outcome,) = compare([case], mug_model, seed=4, progress=False, solver="carry", reconstruct=False)
    estimates, confidences, removed = imitated(mug_model, [case], seed=4, progress=False)
    np.testing.assert_array_equal(outcome.estimates, estimates)
    np.testing.assert_array_equal(outcome.confidence, confidences)
    assert outcome.removed.tolist() == removed.tolist() == [0]
    assert outcome.distance[0] < 0.02 and outcome.angle[0] < 20 and confidences[0] > 0.9
    assert outcome.ious == {"iou": [None], "iou_refined": [None]}


def test_an_unknown_solver_is_refused(pair, small_model):
    with pytest.raises(InputError, match="solver is 'newton'"):
        compare([pair], small_model, solver="newton")
