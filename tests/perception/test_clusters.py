"""Objects on a table: one cloud each, whatever the order, and what is not an object is left out."""

import numpy as np
import pytest

import tdf_jax as tdf
from tdf_jax.perception.clusters import clusters_of, separate_objects

TABLE = 9000


def table(seed=0):
    rng = np.random.default_rng(seed)
    return np.column_stack([rng.uniform(-0.3, 0.3, (TABLE, 2)), 0.0007 * rng.normal(size=TABLE)])


def standing(shape, x, y, count, seed=0):
    """Points of an object on the table, without what is within 3 mm of it."""
    points = tdf.sample_surface(shape.mesh, count, seed)
    points[:, 2] -= shape.mesh.bounds[0, 2]
    return points[points[:, 2] > 0.003] + (x, y, 0)


@pytest.fixture(scope="module")
def parts():
    """A mug, a bottle and a bowl, 3 cm apart or more."""
    mug, bottle, bowl = tdf.build_mug(), tdf.build_bottle(), tdf.build_bowl()
    right = mug.mesh.bounds[1, 0] + 0.03 - bottle.mesh.bounds[0, 0]
    return standing(mug, 0, 0, 3000), standing(bottle, right, 0, 2500), standing(bowl, 0, 0.19, 2000)


@pytest.fixture(scope="module")
def scene(parts):
    return np.concatenate([table(), *parts])


def rows(points):
    return {tuple(point) for point in points}


def test_every_object_is_one_cloud_the_largest_first(scene, parts):
    found = separate_objects(scene)
    assert len(found) == 3
    for cloud, part in zip(found, parts):
        assert len(rows(part) - rows(cloud)) <= 0.005 * len(part)
        assert len(rows(cloud) - rows(part)) <= 0.005 * len(cloud)


def test_neither_order_nor_points_at_3_metres_matter(scene):
    expected = [rows(cloud) for cloud in separate_objects(scene)]
    assert [rows(cloud) for cloud in separate_objects(np.random.default_rng(1).permutation(scene))] == expected
    away = np.vstack([scene, [[3.0, 0, 0.1]]])
    assert [rows(cloud) for cloud in separate_objects(away)] == expected


def test_points_keep_order_and_type(scene):
    narrow = scene.astype(np.float32)
    for cloud in separate_objects(narrow):
        assert cloud.dtype == np.float32
        index = [np.flatnonzero((narrow == point).all(axis=1))[0] for point in cloud[::200]]
        assert index == sorted(index)


def test_a_workspace_leaves_walls_and_floors_out(scene, parts):
    rng = np.random.default_rng(2)
    wall = np.column_stack([np.full(20000, 0.5), rng.uniform(-1, 1, 20000), rng.uniform(-0.5, 1, 20000)])
    box = (-0.3, -0.3, -0.05, 0.3, 0.3, 0.4)
    found = separate_objects(np.concatenate([scene, wall]), box)
    assert [len(cloud) for cloud in found] == [len(cloud) for cloud in separate_objects(scene)]
    same = separate_objects(np.concatenate([scene, wall]), np.reshape(box, (2, 3)))
    assert [rows(cloud) for cloud in same] == [rows(cloud) for cloud in found]


def test_a_workspace_above_the_table_needs_no_plane(scene, parts):
    found = separate_objects(scene, (-0.3, -0.3, 0.01, 0.3, 0.3, 0.4), plane=False)
    assert len(found) == 3
    assert rows(found[0]) == {tuple(point) for point in parts[0] if point[2] >= 0.01}


def test_small_clusters_are_left_out(scene):
    speck = np.random.default_rng(3).normal(size=(60, 3)) * 0.002 + (-0.2, -0.2, 0.03)
    assert len(separate_objects(np.concatenate([scene, speck]), min_points=100)) == 3
    assert len(separate_objects(np.concatenate([scene, speck]), min_points=40)) == 4


def test_a_peg_behind_its_post_belongs_to_the_rack():
    """A floating fragment 4 cm from a standing object is its part; one on the table, or as large, is not."""
    rng = np.random.default_rng(4)
    post = np.column_stack([rng.uniform(0, 0.02, (3000, 2)), rng.uniform(0.003, 0.2, 3000)])
    peg = np.column_stack([rng.uniform(0.06, 0.08, 120), rng.uniform(0, 0.006, 120), rng.uniform(0.18, 0.186, 120)])
    found = separate_objects(np.concatenate([table(), post, peg]))
    assert [len(cloud) for cloud in found] == [3120]
    found = separate_objects(np.concatenate([table(), post, peg - (0, 0, 0.175)]))
    assert len(found) == 2
    other = np.column_stack([rng.uniform(0.06, 0.1, (2000, 2)), rng.uniform(0.05, 0.2, 2000)])
    assert len(separate_objects(np.concatenate([table(), post, other]))) == 2


def test_stray_points_do_not_bridge_objects():
    rng = np.random.default_rng(5)
    blocks = [rng.uniform(0, 0.04, (3000, 3)) + (x, 0, 0) for x in (0, 0.11)]
    bridge = np.column_stack([np.linspace(0.045, 0.105, 7), np.full((7, 2), 0.02)])
    found = clusters_of(np.concatenate([*blocks, bridge]))
    assert len(set(found[:3000])) == len(set(found[3000:6000])) == 1
    assert found[0] != found[3000] and (found[6002:6005] == -1).all()


def test_unevenness_of_the_table_is_no_object(scene):
    bump = table(7)[:4000] * (0.1, 0.1, 0.3) + (-0.2, -0.2, 0.0032)
    assert len(separate_objects(np.concatenate([scene, bump]))) == 3


def test_the_table_of_a_far_view_is_removed_by_its_own_noise(parts):
    """Merged with a near view of nine times as many points, a sixth of a far one's table would be above its noise."""
    near, far = np.concatenate([table(1), *parts]), table(2)[:3000] * (1, 1, 6)
    found = separate_objects([near, far], camera=[(0, 0, 0.5), (0.3, 0, 1.2)])
    assert len(found) == 3
    for cloud, part in zip(found, parts):
        assert len(rows(cloud) - rows(part)) <= 0.01 * len(cloud) and len(rows(part) - rows(cloud)) <= 0.01 * len(part)
    assert sum(map(len, separate_objects(np.concatenate([near, far]), camera=(0, 0, 0.5)))) > 1.01 * sum(
        map(len, found)
    )
    with pytest.raises(tdf.InputError, match=r"camera has the shape \(3,\); expected .* of each of 2 views"):
        separate_objects([near, far], camera=(0, 0, 0.5))


@pytest.mark.parametrize(
    ("keywords", "words"),
    [
        ({"workspace": (0, 0, 0, 1, 1)}, "workspace is .*expected the smallest"),
        ({"workspace": (0.3, -0.3, 0, -0.3, 0.3, 1)}, "xmin ymin zmin xmax ymax zmax"),
        ({"workspace": (100, 100, 0, 300, 300, 100)}, "points is in the workspace"),
        ({"workspace": (-0.1, -0.1, 0.03, 0.1, 0.1, 1)}, "there is no plane .* plane=False"),
        ({"gap": 0}, "gap is 0"),
        ({"min_points": 9000}, "no cluster has 9000 points: the largest of 3 clusters has"),
        ({"plane": 1}, "plane is 1"),
        ({"camera": (0, 0, -1.0)}, "no cluster has 50 points"),
    ],
)
def test_bad_input_is_refused(scene, keywords, words):
    with pytest.raises(tdf.InputError, match=rf"separate_objects\(\): .*{words}"):
        separate_objects(scene, **keywords)
