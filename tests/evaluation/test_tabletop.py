"""Objects on a table: poses, neighbours, complete clouds and depth images with foreign points, places in sight."""

import functools

import numpy as np
import pytest
import trimesh
from scipy.spatial import KDTree

from tdf_jax._internal.errors import InputError
from tdf_jax.cli.evaluate import _conditions
from tdf_jax.evaluation.annotated_meshes import AnnotatedMesh
from tdf_jax.evaluation.cases import generated_case, mesh_case
from tdf_jax.evaluation.depth_images import depth_image
from tdf_jax.evaluation.pick_report import _by_sight, condition, meaning
from tdf_jax.evaluation.pick_transfer import summary
from tdf_jax.evaluation.tabletop import (
    CLUTTER,
    NEIGHBOURS,
    OWN,
    SHARE,
    build_tabletop,
    complete_cloud,
    image_points,
    images,
    moved,
    place_points,
    segmented,
    standing,
)
from tdf_jax.geometry.sampling import sample_surface

BOX = trimesh.creation.box((0.06, 0.08, 0.1))
ROD = trimesh.creation.cylinder(0.03, 0.16)


@pytest.fixture(autouse=True)
def small_images(monkeypatch):
    """A quarter of the pixels, which are a quarter of the time."""
    small = functools.partial(depth_image, width=320, height=240)
    monkeypatch.setattr("tdf_jax.evaluation.tabletop.depth_image", small)


def generator(seed=0):
    return np.random.default_rng(seed)


@pytest.mark.parametrize(("stand", "steepest"), [("upright", 1e-6), ("tilt60", 85)])
def test_objects_stand_on_the_table(stand, steepest):
    tilts = []
    for seed in range(20):
        T = standing(BOX, stand, generator(seed))
        np.testing.assert_allclose(moved(BOX.vertices, T)[:, 2].min(), 0, atol=1e-12)
        tilts.append(np.degrees(np.arccos(min(T[2, 2], 1))))
    assert max(tilts) < steepest and (stand == "upright" or max(tilts) > 40)
    np.testing.assert_array_equal(T, standing(BOX, stand, generator(19)))


@pytest.mark.parametrize("gap", [0.03, 0.002])
def test_a_neighbour_stands_upright_at_its_gap_and_hides_nothing_from_the_first_camera(gap):
    for seed in range(3):
        T = standing(BOX, "tilt60", generator(seed))
        scene = build_tabletop(BOX, T, 2, generator(seed), ROD, gap)
        alone = build_tabletop(BOX, T, 2, generator(seed))
        assert scene.neighbour is not None
        np.testing.assert_array_equal(scene.T_world_cameras, alone.T_world_cameras)
        assert scene.neighbour.bounds[0, 2] == pytest.approx(0, abs=1e-9)
        assert scene.neighbour.extents[2] == pytest.approx(0.16)
        near = KDTree(moved(sample_surface(BOX, 8000, 0), T)).query(
            sample_surface(scene.neighbour, 8000, 0), distance_upper_bound=2 * gap
        )[0]
        assert near.min() == pytest.approx(gap, abs=0.0015)
        towards = [scene.T_world_cameras[0, :2, 3], scene.neighbour.bounds.mean(axis=0)[:2]] - T[:2, 3]
        cosine = np.prod(towards, axis=0).sum() / np.linalg.norm(towards, axis=1).prod()
        assert abs(cosine) < 0.8


@pytest.mark.parametrize("clutter", CLUTTER)
def test_a_fifth_of_a_cluttered_cloud_is_foreign(clutter):
    T = standing(BOX, "upright", generator(1))
    scene = build_tabletop(BOX, T, 1, generator(1), ROD if clutter in NEIGHBOURS else None, 0.03)
    own = sample_surface(BOX, 400, 0)
    points, count = complete_cloud(scene, clutter, own, generator(2))
    assert count == 400
    np.testing.assert_allclose(points[:count], moved(own, T))
    foreign, local = points[count:], moved(points[count:], np.linalg.inv(T))
    assert len(foreign) == (0 if clutter == "none" else round(400 * SHARE / (1 - SHARE)))
    if clutter == "table":
        assert (foreign[:, 2] == 0).all()
        beside = np.abs(local[:, :2]) - [0.03, 0.04]
        assert (beside.max(axis=1) > -0.01).all()  # none is under the box
        assert beside.max() < 0.06  # a strip
    elif scene.neighbour is not None:
        radius = np.linalg.norm(foreign[:, :2] - scene.neighbour.bounds.mean(axis=0)[:2], axis=1)
        assert (radius < 0.0301).all()
        assert KDTree(points[:count]).query(foreign)[0].min() > 0.03
    elif clutter == "outliers":
        far = np.linalg.norm(local, axis=1)
        assert ((far > 0.29) & (far < 1.01)).sum() == 50 and (far < 0.2).sum() == 50


@pytest.mark.parametrize("count", [1, 2])
def test_depth_images_give_the_object_without_the_table(count):
    """Also where the second camera is farther, and has six times the noise of the first."""
    distances = iter([0.4, 1.0])
    T = standing(BOX, "upright", generator(3))
    scene = build_tabletop(BOX, T, count, generator(3))
    for camera in scene.T_world_cameras:
        camera[:3, 3] = T[:3, 3] - next(distances) * camera[:3, 2]
    views, labels = zip(*(image_points(image) for image in images(scene, generator(4))))
    points, labels = np.concatenate(views), np.concatenate(labels)
    cluster = segmented(scene, list(views), labels)
    assert (labels[cluster] == OWN).mean() > 0.98
    assert cluster[labels == OWN].mean() > 0.95
    offset = np.abs(moved(points[cluster], np.linalg.inv(T))) - [0.03, 0.04, 0.05]
    assert np.quantile(np.abs(offset.max(axis=1)), 0.9) < 0.004


def test_cases_of_depth_images_have_a_pose_on_the_table_and_foreign_points_of_their_images():
    first = generated_case("bottle", 3, 1, points=60, clouds="camera1")
    assert first.own is not None and 0.98 < first.own / len(first.points_b) <= 1
    case = generated_case("bottle", 3, 1, points=60, clouds="camera1", clutter="neighbour-other")
    np.testing.assert_array_equal(case.T_world_b, first.T_world_b)
    assert (first.stand, case.clutter) == ("upright", "neighbour-other") and first.T_world_b[2, 2] > 1 - 1e-9
    foreign = case.points_b[case.own :]
    assert len(foreign) == pytest.approx(SHARE * len(case.points_b), abs=1)
    surface = KDTree(moved(sample_surface(case.object_b.mesh, 5000, 0), case.T_world_b))
    assert np.quantile(surface.query(case.points_b[: case.own])[0], 0.98) < 0.01
    assert np.quantile(surface.query(foreign)[0], 0.02) > 0.02
    plain = generated_case("bottle", 3, 1, points=60)
    assert (plain.stand, plain.clutter, plain.seen, plain.own) == ("", "none", None, 60)


def test_a_real_mesh_can_be_seen_by_depth_cameras():
    frame = np.eye(4)
    frame[:3, 3] = 0, 0, 0.05
    one = AnnotatedMesh("box", BOX, 0.1, {"neck": frame, "base": frame, "body": frame}, "bottle", 2)
    case = mesh_case(3, 0, one, clouds="camera1", stand="tilt60", points=60)
    assert case.stand == "tilt60" and case.T_world_b[2, 2] < 1 and len(case.points_b) > 500
    assert case.points_b[: case.own, 2].min() > -0.01


def test_a_place_is_seen_by_the_points_around_it_or_around_an_equivalent_one():
    frame = np.eye(4)
    frame[:3, 3] = 0.05, 0, 0
    near, opposite, above = (np.tile(x, (30, 1)) for x in ([0.06, 0, 0], [-0.06, 0, 0.01], [0, 0, 0.1]))
    cloud = np.concatenate([near, above, above, above, above])
    assert place_points(cloud, [frame], 1, 0.06) == 300  # a fifth of 1500
    cloud = np.concatenate([opposite, above])
    assert [place_points(cloud, [frame], fold, 0.06) for fold in (1, 2, 4, 0)] == [0, 750, 750, 750]
    other = np.diag([1.0, 1, 1, 1])
    other[:3, 3] = -0.05, 0, 0
    assert place_points(cloud, [frame, other], 1, 0.06) == 750


def test_rows_are_divided_by_whether_the_place_is_seen():
    import dataclasses

    plain = generated_case("bottle", 3, 1, points=60)
    cases = [dataclasses.replace(plain, instance=str(seen), seen=seen) for seen in (20, 90, 19, 0)]
    distance, angle, none = np.array([0.005, 0.03, 0.05, 0.2]), np.zeros(4), {"iou": [None] * 4}
    row = summary(distance, angle, none, cases, confidence=np.array([0.9, 0.4, 0.6, 0.1]))
    seen, hidden = (row["by_sight"][name] for name in ("seen", "hidden"))
    assert (seen["cases"], seen["success_1cm_10deg"], seen["doubted"]) == (2, 0.5, 0.5)
    assert (hidden["cases"], hidden["success_5cm_30deg"], hidden["doubted"]) == (2, 0.5, 0.5)
    assert [cells[:2] for cells in _by_sight(row)] == [["seen", "2"], ["hidden", "2"]]
    assert summary(distance, angle, none, cases)["by_sight"]["hidden"]["doubted"] is None
    assert summary(distance, angle, none, [plain] * 4)["by_sight"] == {}


def test_clouds_clutter_and_stands_are_combined_where_there_is_a_table():
    found = _conditions(("full", "camera1", "noise"), ("none",), ("upright", "tilt60"))
    assert list(found) == ["full", "camera1", "camera1, tilt60", "noise"]
    found = _conditions(("full", "camera2"), ("none", "outliers"), ("upright",))
    assert list(found) == ["full", "full, outliers", "camera2", "camera2, outliers"]
    assert found["camera2, outliers"] == {"clouds": "camera2", "clutter": "outliers", "stand": "upright"}
    assert len(_conditions(("all",), ("all",), ("upright",))) == 10 + 1 + 3 + 4 * (len(CLUTTER) - 1)
    for name in _conditions(("all",), ("all",), ("upright", "tilt60")):
        assert meaning(name)
    assert condition("full", "table", "tilt60") == "full, table, tilt60"


@pytest.mark.parametrize(("call", "message"), [
    (lambda: _conditions(("noise",), ("table",), ("upright",)), "--clutter table with --clouds noise"),
    (lambda: _conditions(("full",), (), ("upright",)), "--clutter is empty"),
    (lambda: _conditions(("full",), ("none",), ()), "--stand is empty"),
    (lambda: generated_case("mug", 0, 0, clouds="half", clutter="table"), "clouds, with clutter,"),
    (lambda: generated_case("mug", 0, 0, clutter="dust"), "clutter"),
    (lambda: generated_case("mug", 0, 0, stand="upside down"), "stand"),
])  # fmt: skip
def test_what_cannot_be_combined_is_refused(call, message):
    with pytest.raises(InputError, match=message):
        call()
