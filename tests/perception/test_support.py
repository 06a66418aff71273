"""The plane under objects: found where it was put, on the side of the objects, with the band of its own noise."""

import numpy as np
import pytest

import tdf_jax as tdf
from tdf_jax.perception.support import find_support, remove_plane

NORMAL = np.array([0.36, -0.48, 0.8])


def axes():
    """A rotation whose z axis is the normal."""
    x = np.cross([0, 1.0, 0], NORMAL)
    x /= np.linalg.norm(x)
    return np.column_stack([x, np.cross(NORMAL, x), NORMAL])


def table(noise=0.001, count=6000, seed=0):
    rng = np.random.default_rng(seed)
    return np.column_stack([rng.uniform(-0.3, 0.3, (count, 2)), noise * rng.normal(size=count)])


def block(count=1500, low=0.0, high=0.08, seed=1):
    """Sides and top of a block on the table."""
    rng = np.random.default_rng(seed)
    side = rng.uniform(-0.04, 0.04, (count, 3))
    side[:, 2] = rng.uniform(low, high, count)
    face = rng.integers(3, size=count)
    side[face == 0, 0] = 0.04
    side[face == 1, 1] = -0.04
    side[face == 2, 2] = high
    return side


def placed(points):
    """In a frame in which the table is tilted and 0.5 m away."""
    return points @ axes().T + 0.5 * NORMAL


def rows(points):
    return {tuple(point) for point in points}


@pytest.mark.parametrize("noise", [0.0, 0.001, 0.003])
def test_the_plane_is_found_and_the_object_stays(noise):
    on, up = placed(table(noise)), placed(block(low=4 * noise))
    kept, plane = remove_plane(np.concatenate([on, up]), return_plane=True)
    np.testing.assert_allclose(plane, [*NORMAL, -0.5], atol=4e-4 if noise else 1e-6)
    assert np.linalg.norm(plane[:3]) == pytest.approx(1)
    assert len(rows(kept) & rows(on)) <= 0.004 * len(on)
    assert len(rows(up) - rows(kept)) <= 0.01 * len(up)


def test_the_band_is_that_of_the_planes_own_noise():
    for noise in (0.0005, 0.002):
        scene = np.concatenate([table(noise), block()])
        support = find_support("test()", scene)
        assert support.noise == pytest.approx(noise, rel=0.1)
        lost = block()[~support.in_front(scene)[6000:]]
        assert lost[:, 2].max() < 4.2 * noise


def test_noisier_places_have_a_wider_band():
    on = table(0.0005, 20000)
    on[:, 2] *= np.where(on[:, 0] > 0.1, 4.0, 1.0)
    support = find_support("test()", np.concatenate([on, block()]))
    bands = support.bands(np.concatenate([on, block()]))[:20000]
    assert np.median(bands[on[:, 0] > 0.16]) == pytest.approx(3 * 0.002, rel=0.2)
    assert np.median(bands[on[:, 0] < 0.04]) == pytest.approx(3 * 0.0005, rel=0.2)


def test_a_low_bowl_and_the_base_of_a_rack_stay():
    """What is 4 mm above the table is not the table's where that has 1 mm noise."""
    bowl = tdf.build_bowl(tdf.BowlParameters(height=0.022, radius=0.06, wall_thickness=0.0035, bottom_thickness=0.004))
    rack = tdf.build_rack()
    for shape, low in ((bowl, 0.0035), (rack, rack.parameters.base_thickness / 2)):
        surface = tdf.sample_surface(shape.mesh, 6000, 0)
        surface[:, 2] -= shape.mesh.bounds[0, 2]
        up = surface[surface[:, 2] > low]
        support = find_support("test()", np.concatenate([table(0.0007), up]))
        assert abs(support.plane[3]) < 3e-4
        assert support.in_front(np.concatenate([table(0.0007), up]))[6000:].mean() > 0.99


def test_objects_are_on_the_side_of_more_points_or_of_the_camera():
    floor = table(seed=3) * (0.7, 1, 1) - (0.7, 0, 0.7)  # beside the table, as a camera above it sees it
    scene = np.concatenate([table(), block(800), floor])
    kept, plane = remove_plane(scene, return_plane=True)
    assert plane[2] > 0.999 and kept[:, 2].min() > 0
    assert remove_plane(scene, camera=(0.5, 0, 0.6), return_plane=True)[1] == pytest.approx(plane)
    kept, plane = remove_plane(scene, camera=(0.5, 0, -0.6), return_plane=True)
    assert plane[2] < -0.999 and kept[:, 2].max() < 0


def test_the_largest_plane_is_that_of_the_largest_area():
    """The top of a block close to the camera has more points."""
    top = block(9000)
    kept, plane = remove_plane(np.concatenate([table(), top]), return_plane=True)
    np.testing.assert_allclose(plane, [0, 0, 1, 0], atol=1e-3)
    assert len(rows(kept) & rows(top)) > 0.95 * len(top)


def test_neither_order_nor_a_point_at_3_metres_matters():
    scene = placed(np.concatenate([table(), block()]))
    kept, plane = remove_plane(scene, return_plane=True)
    mixed, same = remove_plane(np.random.default_rng(5).permutation(scene), return_plane=True)
    assert rows(mixed) == rows(kept)
    np.testing.assert_array_equal(same, plane)
    away = placed(np.array([[3.0, 0, 0.1]]))
    more, same = remove_plane(np.concatenate([scene, away]), return_plane=True)
    assert rows(more) == rows(kept) | rows(away)
    np.testing.assert_array_equal(same, plane)


def test_points_keep_order_and_type():
    scene = np.concatenate([block(), table()]).astype(np.float32)
    kept = remove_plane(scene)
    assert kept.dtype == np.float32
    names = rows(kept)
    assert [tuple(point) for point in kept] == [tuple(point) for point in scene if tuple(point) in names]


@pytest.mark.parametrize(
    ("points", "keywords", "words"),
    [
        (np.random.default_rng(0).normal(size=(500, 3)), {}, "there is no plane of 100 cm2"),
        (table(0.0), {}, "all 6000 points are on the largest plane or behind it"),
        (table(), {"camera": (0, 0)}, "camera is"),
        (table(), {"return_plane": "yes"}, "return_plane is 'yes'"),
        (table()[:10], {}, "10 points"),
    ],
)
def test_bad_input_is_refused(points, keywords, words):
    with pytest.raises(tdf.InputError, match=rf"remove_plane\(\): .*{words}"):
        remove_plane(points, **keywords)
