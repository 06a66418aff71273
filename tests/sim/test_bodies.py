"""Bodies of generated objects: masses within the limits, inertia of even material."""

import numpy as np
import pytest
import trimesh

import tdf_jax as tdf
from tdf_jax._internal.errors import InputError
from tdf_jax.shapes import FAMILIES
from tdf_jax.sim.board import Board
from tdf_jax.sim.bodies import body_of
from tdf_jax.sim.physics import MASSES, object_mass


def test_masses_are_by_volume_within_the_limits():
    assert MASSES == (0.10, 0.40)
    assert object_mass(1e-6) == 0.10 and object_mass(1.0) == 0.40
    assert object_mass(5e-4) == pytest.approx(0.2)  # half a litre at 400 kg/m3


@pytest.mark.parametrize("category", ["mug", "bowl", "bottle"])
def test_the_body_of_a_generated_object(category):
    family = FAMILIES[category]
    shape = family.build(family.sample(np.random.default_rng(5)))
    body = body_of(shape)
    assert 0.10 <= body.mass <= 0.40
    even = shape.mesh.copy()
    even.density = body.mass / even.volume
    np.testing.assert_allclose(body.inertia, even.moment_inertia, rtol=1e-9, atol=1e-15)
    np.testing.assert_allclose(body.centre, even.center_mass, atol=1e-12)
    corners = np.concatenate(body.parts)
    np.testing.assert_allclose([corners.min(axis=0), corners.max(axis=0)], shape.mesh.bounds, atol=5e-4)


def test_inertia_scales_with_a_given_mass():
    mug = tdf.build_mug()
    light, heavy = body_of(mug, 0.01), body_of(mug, 0.3)
    assert (light.mass, heavy.mass) == (0.01, 0.3)
    np.testing.assert_allclose(heavy.inertia, 30 * light.inertia)
    for wrong in (0, -1, np.nan):
        with pytest.raises(InputError, match=r"body_of\(\): mass is"):
            body_of(mug, wrong)


def test_a_board_is_two_boxes():
    board = Board(size=(0.2, 0.3, 0.02), height=0.1, block=0.06)
    assert len(body_of(board).parts) == 2
    assert board.mesh.is_watertight
    assert board.mesh.volume == pytest.approx(0.2 * 0.3 * 0.02 + 0.06**2 * 0.08)
    np.testing.assert_allclose(board.mesh.bounds, [(-0.1, -0.15, -0.05), (0.1, 0.15, 0.05)])
    top = trimesh.bounds.corners(board.mesh.bounds)[:, 2].max()
    assert board.boxes[0][:, 2].max() == pytest.approx(top)
