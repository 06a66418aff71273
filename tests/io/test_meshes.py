"""Meshes: samples of their surface, axes of files, inside and outside. Files are read in test_pointclouds.py."""

import sys

import numpy as np
import pytest
import trimesh
from scipy.stats import kstest

from tdf_jax._internal.errors import InputError
from tdf_jax.geometry.sampling import sample_surface
from tdf_jax.geometry.winding import inside, winding_number
from tdf_jax.io.meshes import AXES, file_axes
from tdf_jax.shapes import build_mug, sample_mug


def test_surface_samples_are_uniform_by_area():
    """Two triangles of areas 1 and 3: a quarter of the points on the first, spread evenly within each."""
    vertices = [[0, 0, 0], [2, 0, 0], [0, 1, 0], [0, 0, 5], [6, 0, 5], [0, 1, 5]]
    mesh = trimesh.Trimesh(vertices, [[0, 1, 2], [3, 4, 5]], process=False)
    points = sample_surface(mesh, 8000, np.random.default_rng(0))
    first = points[:, 2] == 0
    assert abs(first.mean() - 0.25) < 0.02
    for part, width in ((points[first], 2), (points[~first], 6)):
        x, y = part[:, 0] / width, part[:, 1]
        assert (x >= 0).all() and (y >= 0).all() and (x + y <= 1 + 1e-12).all()
        # Uniform on the unit triangle: P(x <= a) = 1 - (1 - a)^2, and the same for y and for 1 - x - y.
        for coordinate in (x, y, 1 - x - y):
            assert kstest(coordinate, lambda a: 1 - (1 - np.clip(a, 0, 1)) ** 2).pvalue > 0.01


def test_surface_samples_follow_the_generator_and_refuse_nothing():
    box = trimesh.creation.box((1, 2, 3))
    first, second = (sample_surface(box, 5, np.random.default_rng(3)) for _ in range(2))
    np.testing.assert_array_equal(first, second)
    with pytest.raises(InputError, match="count is 0"):
        sample_surface(box, 0, np.random.default_rng(0))
    with pytest.raises(InputError, match="1 faces has no area"):
        sample_surface(trimesh.Trimesh([[0, 0, 0], [1, 0, 0], [2, 0, 0]], [[0, 1, 2]], process=False), 5, None)


def test_axes_of_a_file_become_up_z_front_x():
    count = 0
    for up in AXES:
        for front in AXES:
            if up[1] == front[1]:
                with pytest.raises(InputError, match="which are parallel; expected two different axes"):
                    file_axes(up, front)
                continue
            R_file_object = file_axes(up, front)
            np.testing.assert_allclose(R_file_object @ R_file_object.T, np.eye(3), atol=1e-15)
            assert np.linalg.det(R_file_object) > 0
            np.testing.assert_array_equal(AXES[up] @ R_file_object, [0, 0, 1])
            np.testing.assert_array_equal(AXES[front] @ R_file_object, [1, 0, 0])
            count += 1
    assert count == 24
    with pytest.raises(InputError, match=r"'up' is no axis; expected one of \+x, -x, \+y"):
        file_axes("up", "+x")


def test_winding_numbers_of_a_box_closed_open_and_inside_out():
    pytest.importorskip("igl")
    box = trimesh.creation.box((1, 2, 3))
    x = np.random.default_rng(0).uniform(-2, 2, (500, 3))
    inside = (np.abs(x) < [0.5, 1, 1.5]).all(axis=1)
    np.testing.assert_allclose(winding_number(box, x), inside, atol=0.02)
    turned = trimesh.Trimesh(box.vertices, box.faces[:, ::-1], process=False)
    np.testing.assert_allclose(winding_number(turned, x), -1.0 * inside, atol=0.02)
    # Without its two triangles at -x, what is seen of the gap is missing: a sixth of the sphere and more near it.
    gap = trimesh.Trimesh(box.vertices, box.faces[box.face_normals[:, 0] > -0.5], process=False)
    near = np.array([[-0.45, 0, 0], [0.45, 0, 0]])
    assert 0.45 < winding_number(gap, near)[0] < 0.6 and winding_number(gap, near)[1] > 0.75


@pytest.mark.parametrize("index", range(3))
def test_inside_agrees_with_generated_mugs(index):
    """Also with faces turned inwards, and with a hole; without half of its faces, a mug has no inside."""
    pytest.importorskip("igl")
    mug = build_mug(sample_mug(np.random.default_rng([9, index])))
    low, high = mug.mesh.bounds
    x = np.random.default_rng(0).uniform(low - 0.02, high + 0.02, (4000, 3))
    expected = mug.contains(x)
    assert expected.sum() > 100
    np.testing.assert_array_equal(inside(mug.mesh, x), expected)
    np.testing.assert_array_equal(
        inside(trimesh.Trimesh(mug.mesh.vertices, mug.mesh.faces[:, ::-1], process=False), x), expected
    )
    assert np.mean(inside(trimesh.Trimesh(mug.mesh.vertices, mug.mesh.faces[3:], process=False), x) == expected) > 0.998
    half = np.random.default_rng(1).random(len(mug.mesh.faces)) < 0.5
    assert inside(trimesh.Trimesh(mug.mesh.vertices, mug.mesh.faces[half], process=False), x) is None


def test_a_missing_library_is_named(monkeypatch):
    monkeypatch.setitem(sys.modules, "igl", None)
    with pytest.raises(
        InputError, match=r"libigl is not installed; expected the extra 'mesh'; run: pip install 'tdf_jax\[mesh\]'"
    ):
        winding_number(trimesh.creation.box(), np.zeros((1, 3)))
