"""Paths by hand: their ends, spacing and turns."""

import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation, Slerp

from tdf_jax._internal.errors import InputError
from tdf_jax.geometry.paths import PATHS, SHAPES, hang_on_rack, lift_over, line, semicircle, tilt_and_pour, wave

IDENTITY = np.array([1, 0, 0, 0, 0, 0, 0], np.float32)


def test_the_default_line_by_hand():
    expected = [[0, 0.05 * i, 0] for i in range(7)]
    np.testing.assert_allclose(line().translations, expected, atol=1e-7)
    np.testing.assert_array_equal(line().wxyz_xyz[:, :4], np.tile(IDENTITY[:4], (7, 1)))


def test_the_default_semicircle_by_hand():
    """Steps of 30 degrees about the chord's middle, radius 0.15, towards +x."""
    angles = np.deg2rad(30 * np.arange(7))
    expected = 0.15 * np.stack([np.sin(angles), 1 - np.cos(angles), 0 * angles], axis=1)
    np.testing.assert_allclose(semicircle().translations, expected, atol=1e-7)


def test_the_default_wave_by_hand():
    """One sine of amplitude 0.3 / 4: its crest is at a quarter of the way, its middle on the chord."""
    t = np.array(wave(num_poses=9).translations)
    np.testing.assert_allclose(t[[0, 2, 4, 6, 8], 0], [0, 0.075, 0, -0.075, 0], atol=1e-6)
    np.testing.assert_allclose(t[[0, 2, 4, 6, 8], 1], [0, 0.075, 0.15, 0.225, 0.3], atol=1e-6)
    np.testing.assert_allclose(t[:, 0], 0.075 * np.sin(2 * np.pi * t[:, 1] / 0.3), atol=1e-6)
    np.testing.assert_array_equal(t[:, 2], 0)


def test_heights_and_bulges():
    arc = np.array(semicircle(3, (0, 0, 0), (2, 0, 0), height=0.5, bulge=(7, 0, 3)).translations)
    np.testing.assert_allclose(arc, [[0, 0, 0], [1, 0, 0.5], [2, 0, 0]], atol=1e-6)
    # Over half a circle: chord 2 and height 2 give radius 1.25 about a centre 0.75 above the chord.
    deep = np.array(semicircle(21, (0, 0, 0), (2, 0, 0), height=2, bulge=(0, 0, 1)).translations)
    np.testing.assert_allclose(np.linalg.norm(deep - [1, 0, 0.75], axis=1), 1.25, atol=1e-6)
    crest = np.array(wave(5, (0, 0, 0), (0, 0, 4), height=0.5, bulge=(0, -1, 9)).translations)
    np.testing.assert_allclose(crest[1::2], [[0, -0.5, 1], [0, 0.5, 3]], atol=1e-5)


@pytest.mark.parametrize("path", PATHS.values())
@pytest.mark.parametrize("poses", [2, 5, 60])
def test_paths_keep_their_ends_and_are_evenly_spaced(path, poses):
    start, end = (0.1, -0.2, 0.3), (-0.4, 0.5, 0.1)
    trajectory = path(poses, start, end)
    assert trajectory.num_poses == poses
    assert trajectory.wxyz_xyz.dtype == jnp.float32
    np.testing.assert_allclose(trajectory.translations[0], start, atol=1e-7)
    np.testing.assert_allclose(trajectory.translations[-1], end, atol=1e-7)
    if poses == 60:  # few poses cut corners
        steps = np.linalg.norm(np.diff(np.array(trajectory.translations), axis=0), axis=1)
        corner = path not in SHAPES.values()  # where up to two steps are cut
        assert np.sum(np.abs(steps / steps.mean() - 1) > (0.05 if corner else 5e-3)) <= 2 * corner


@pytest.mark.parametrize("path", SHAPES.values())
def test_orientations_turn_evenly_from_one_to_the_other(path):
    first, last = Rotation.from_rotvec([0.3, -0.5, 1]), Rotation.from_rotvec([-1, 0.2, 0.4])
    fixed = path(4, rotation=first.as_matrix())
    np.testing.assert_allclose(fixed.rotations, np.tile(first.as_matrix(), (4, 1, 1)), atol=1e-6)
    turning = path(5, rotation=first.as_quat(scalar_first=True), end_rotation=last.as_matrix())
    expected = Slerp([0, 1], Rotation.concatenate([first, last]))(np.linspace(0, 1, 5)).as_matrix()
    np.testing.assert_allclose(turning.rotations, expected, atol=1e-6)
    np.testing.assert_array_equal(turning.translations, path(5).translations)


@pytest.mark.parametrize("path", PATHS.values())
def test_paths_refuse_bad_arguments(path):
    name = path.__name__
    for poses in (1, 0, -3, 2.5):
        with pytest.raises(
            InputError, match=rf"{name}\(\): num_poses is {poses}; expected a whole number of at least 2"
        ):
            path(poses)
    for bad in ((0, 0), (0, 0, np.nan), 3.0, (0, np.inf, 0)):
        with pytest.raises(InputError, match=rf"{name}\(\): start is .*expected three finite numbers"):
            path(start=bad)
        with pytest.raises(InputError, match=rf"{name}\(\): end is .*expected three finite numbers"):
            path(end=bad)
    with pytest.raises(InputError, match=r"start and end are both \[0.0, 0.3, 0.0\]"):
        path(start=(0, 0.3, 0))
    for bad in (np.diag([1.0, 1, -1]), 2 * np.eye(3), np.full((3, 3), np.nan)):
        with pytest.raises(InputError, match="not orthonormal with determinant 1, or not finite"):
            path(rotation=bad)
        if path is not tilt_and_pour:
            with pytest.raises(InputError, match="not orthonormal with determinant 1, or not finite"):
                path(end_rotation=bad)
    for bad in (np.zeros(4), np.ones(4), np.full(4, np.nan)):
        with pytest.raises(InputError, match="of norm .*expected a quaternion of norm 1"):
            path(rotation=bad)
    with pytest.raises(InputError, match=r"rotation has shape \(3,\)"):
        path(rotation=np.zeros(3))


@pytest.mark.parametrize("path", [semicircle, wave])
def test_curved_paths_refuse_bad_heights_and_bulges(path):
    for height in (0, -0.1, np.nan, np.inf, (1, 2)):
        with pytest.raises(InputError, match="height is .*; expected a positive number, metres; reverse bulge"):
            path(height=height)
    for bulge in ((0, 1, 0), (0, -2, 0), (0, 0, 0)):
        with pytest.raises(InputError, match="is zero or along the chord"):
            path(bulge=bulge)
    with pytest.raises(InputError, match="bulge is .*; expected three finite numbers"):
        path(bulge=(1, 0))


def angles_to(trajectory, rotation):
    """Degrees of every pose's orientation from one rotation."""
    return np.degrees((rotation.inv() * Rotation.from_matrix(np.array(trajectory.rotations, np.float64))).magnitude())


def test_a_lift_goes_up_across_and_down():
    """0.15 up, 0.3 across, 0.15 down: 0.6 in six steps of 0.1; it turns on the 0.3 across only."""
    first, last = (
        Rotation.from_rotvec([0.3, -0.5, 1]),
        Rotation.from_rotvec([0.3, 0, 0]) * Rotation.from_rotvec([0.3, -0.5, 1]),
    )
    path = lift_over(7, rotation=first.as_matrix(), end_rotation=last.as_matrix())
    expected = [[0, 0, 0], [0, 0, 0.1], [0, 0.05, 0.15], [0, 0.15, 0.15], [0, 0.25, 0.15], [0, 0.3, 0.1], [0, 0.3, 0]]
    np.testing.assert_allclose(path.translations, expected, atol=1e-6)
    degrees = np.degrees(0.3) * np.array([0, 0, 1 / 6, 1 / 2, 5 / 6, 1, 1])
    np.testing.assert_allclose(angles_to(path, first), degrees, atol=0.05)
    sideways = lift_over(3, height=0.2, up=(-3, 0, 0))
    np.testing.assert_allclose(sideways.translations[1], [-0.2, 0.15, 0], atol=1e-6)


def test_a_pour_stays_upright_until_it_goes_down():
    path = tilt_and_pour(41, height=0.1, tilt=np.radians(80))
    t, degrees = np.array(path.translations), angles_to(path, Rotation.identity())
    np.testing.assert_allclose(t[-1], [0, 0.3, 0], atol=1e-6)
    assert t[:, 2].max() == pytest.approx(0.1, abs=0.005) and (t[:, 0] == 0).all()
    assert (degrees[t[:, 1] < 0.6 * 0.3 - 0.005] < 0.05).all() and degrees[-1] == pytest.approx(80, abs=0.05)
    assert (np.diff(degrees) > -0.05).all()
    # Forwards: what was on top leans towards the end, +y.
    np.testing.assert_allclose(
        np.array(path.rotations[-1]) @ [0, 0, 1], [0, np.sin(np.radians(80)), np.cos(np.radians(80))], atol=1e-5
    )


def test_hanging_ends_straight_and_without_a_turn():
    path = hang_on_rack(31, start=(0.2, 0, 0), approach=(0, 0.1, 0))
    t = np.array(path.translations)
    last = t[:, 1] > 0.2 + 1e-4
    assert last.sum() > 5
    np.testing.assert_allclose(t[last][:, [0, 2]], 0, atol=1e-6)
    quarter = Rotation.from_rotvec([0, np.pi / 2, 0])
    assert (angles_to(path, quarter)[last] < 0.1).all()
    before = angles_to(path, Rotation.identity())[~last]
    assert before[0] < 0.05 and (np.diff(before) > 1).all()
    given = Rotation.from_rotvec([0, 0, 1.0])
    assert angles_to(hang_on_rack(5, start=(0.2, 0, 0), end_rotation=given.as_matrix()), given)[-1] < 0.05


def test_lifts_pours_and_racks_refuse_what_has_no_meaning():
    for height in (0, -0.1, np.nan, (1, 2)):
        for path in (lift_over, tilt_and_pour):
            with pytest.raises(
                InputError, match=rf"{path.__name__}\(\): height is .*; expected a positive number, metres"
            ):
                path(height=height)
    with pytest.raises(InputError, match=r"lift_over\(\): up is zero"):
        lift_over(up=(0, 0, 0))
    with pytest.raises(InputError, match="along the line from start to end"):
        tilt_and_pour(up=(0, -2, 0))
    for tilt in (0, np.pi, 90):
        with pytest.raises(InputError, match=rf"tilt_and_pour\(\): tilt is {tilt}"):
            tilt_and_pour(tilt=tilt)
    for approach in ((0, 0, 0), (0, 0.3, 0)):
        with pytest.raises(InputError, match=r"hang_on_rack\(\): approach is .*not the whole vector"):
            hang_on_rack(approach=approach)
