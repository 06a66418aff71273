import sys

import jax
import numpy as np
import pytest
from conftest import CARRY, random_cloud

import tdf_jax as tdf
from tdf_jax._internal.errors import InputError
from tdf_jax.cli.pictures import check_animation
from tdf_jax.viz import film


@pytest.fixture(scope="module")
def scene(demonstration, field, reference):
    result = tdf.carry(field, reference, jax.random.key(0), config=CARRY)
    return tdf.ImitationScene(
        demonstration, random_cloud(3).astype(np.float32), result, meshes=(None, tdf.build_mug().mesh)
    )


def test_a_film_moves_on_both_sides_and_stays_at_its_end(scene):
    frames = list(film.film_frames(scene, 3))
    assert len(frames) == 2 + film.HOLD
    height, width, _ = frames[0].shape
    assert (width, height) == (640, 360) and width % 2 == height % 2 == 0 and frames[0].dtype == np.uint8
    for before, after in zip(frames[:2], frames[1:3]):
        changed = (before != after).any(axis=2)
        assert changed[:, : width // 2].any() and changed[:, width // 2 :].any()
    np.testing.assert_array_equal(frames[2], frames[-1])


def test_what_cannot_be_a_film_is_refused_at_once(tmp_path, monkeypatch):
    check_animation("tdf imitate", tmp_path / "it.gif")
    with pytest.raises(InputError, match="--animation is it.txt; expected a name that ends in .gif or .mp4"):
        check_animation("tdf imitate", (tmp_path / "it.txt").relative_to(tmp_path))
    with pytest.raises(InputError, match="expected a file in an existing folder"):
        check_animation("tdf imitate", tmp_path / "nowhere" / "it.gif")
    monkeypatch.setitem(sys.modules, "imageio_ffmpeg", None)
    with pytest.raises(InputError, match="MP4 needs the package imageio-ffmpeg"):
        check_animation("tdf imitate", tmp_path / "it.mp4")
