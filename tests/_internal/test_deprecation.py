"""Names of the release before: accepted with a warning, and equal in what they do."""

import numpy as np
import pytest

import tdf_jax as tdf
from tdf_jax._internal.errors import InputError

PATHS = ["line", "semicircle", "wave", "lift_over", "tilt_and_pour", "hang_on_rack"]


@pytest.mark.parametrize("name", PATHS)
def test_paths_take_poses(name):
    path = getattr(tdf, name)
    with pytest.warns(DeprecationWarning, match=rf"^{name}\(poses=...\) is deprecated; use num_poses=$"):
        old = path(poses=4)
    np.testing.assert_array_equal(old.wxyz_xyz, path(num_poses=4).wxyz_xyz)


def test_resample_takes_poses():
    with pytest.warns(DeprecationWarning, match=r"^resample\(poses=...\) is deprecated; use num_poses=$"):
        old = tdf.resample(tdf.line(), poses=4)
    np.testing.assert_array_equal(old.wxyz_xyz, tdf.resample(tdf.line(), num_poses=4).wxyz_xyz)


def test_both_names_at_once_are_refused():
    with pytest.raises(InputError, match=r"^line\(\): got num_poses and poses, its former name; expected num_poses$"):
        tdf.line(poses=4, num_poses=4)


def test_a_trajectory_has_poses():
    with pytest.warns(DeprecationWarning, match=r"^Trajectory.poses is deprecated; use Trajectory.num_poses$"):
        assert tdf.line(5).poses == 5
