"""Pictures and films of a cell: what they show, when they are taken, and the files."""

import numpy as np
import pytest

from tdf_jax._internal.errors import InputError
from tdf_jax.sim import recording
from tdf_jax.sim.recording import Recorder, gl_context

mujoco = pytest.importorskip("mujoco", reason="the extra 'sim' is not installed")

CELL = """<mujoco>
  <worldbody>
    <light pos="0 0 2"/>
    <geom name="table" type="box" size=".4 .6 .02" pos=".55 0 -.02" rgba=".75 .72 .68 1"/>
    <body name="robot/base"><geom type="cylinder" size=".05 .1" pos="0 0 .1" rgba=".2 .2 .2 1"/></body>
    <body name="object" pos=".5 0 .3"><freejoint/><geom type="sphere" size=".06" rgba=".9 .1 .1 1"/></body>
  </worldbody>
</mujoco>"""
SMALL = {"width": 160, "height": 120}


def renderer_or_skip():
    """Skip where nothing renders off screen."""
    try:
        gl_context(16, 16).free()
    except InputError as error:
        pytest.skip(f"PICTURES NOT CHECKED: {error}")


@pytest.fixture(scope="module")
def cell():
    renderer_or_skip()
    model = mujoco.MjModel.from_xml_string(CELL)
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    return model, data


def test_a_picture_shows_the_cell_in_good_light(cell):
    model, data = cell
    with Recorder(model, centre=(0.5, 0, 0.3), **SMALL) as recorder:
        picture = recorder.picture(data).astype(int)
    assert picture.shape == (120, 160, 3)
    red, green, blue = picture[60, 80]  # the sphere is in the middle
    assert red > 120 and red > 2 * green and red > 2 * blue
    red = (picture[..., 0] > 2 * picture[..., 1]) & (picture[..., 0] > 80)
    rows, columns = np.nonzero(red)
    assert abs(rows.mean() - 60) < 2 and abs(columns.mean() - 80) < 2
    radius = 120 / 2 / np.tan(np.radians(20)) * 0.06 / recording.DISTANCE
    assert red.sum() == pytest.approx(np.pi * radius**2, rel=0.15)
    assert np.mean(picture.max(axis=2) < 25) < 0.02  # nothing is black: there is a ground, and light
    assert np.mean(picture[:10]) > 150


def test_a_film_is_possible_where_pictures_are(cell, tmp_path):
    recording.check_film(tmp_path / "film.gif")
    assert not list(tmp_path.iterdir())
    with pytest.raises(InputError, match="film.avi; expected a name that ends in .gif or .mp4"):
        recording.check_film(tmp_path / "film.avi")


def test_pictures_leave_the_model_and_the_state_as_they_are_and_are_equal_again(cell):
    model, data = cell
    before = np.zeros(mujoco.mj_sizeModel(model), np.uint8), data.qpos.copy()
    mujoco.mj_saveModel(model, None, before[0])
    with Recorder(model, **SMALL) as recorder, Recorder(model, **SMALL) as other:
        first = recorder.picture(data)
        np.testing.assert_array_equal(first, other.picture(data))  # two at the same time
        np.testing.assert_array_equal(first, recorder.picture(data))
    after = np.zeros_like(before[0])
    mujoco.mj_saveModel(model, None, after)
    np.testing.assert_array_equal(after, before[0])
    np.testing.assert_array_equal(data.qpos, before[1])


def test_a_film_has_its_pictures_at_even_times(cell, monkeypatch):
    model, data = cell[0], mujoco.MjData(cell[0])
    times = []
    monkeypatch.setattr(
        Recorder, "picture", lambda self, data: times.append(data.time) or np.zeros((4, 6, 3), np.uint8)
    )
    with Recorder(model, rate=20, **SMALL) as recorder:
        for step in range(250):
            mujoco.mj_step(model, data)
            recorder.watch(data, step, "")
    assert len(recorder.frames) == len(times) == 10
    np.testing.assert_allclose(np.diff(times), 0.05, atol=0.0021)


def test_a_closed_recorder_keeps_its_pictures_and_takes_no_more(cell):
    model, data = cell
    recorder = Recorder(model, **SMALL)
    recorder.take(data)
    recorder.close()
    recorder.close()
    assert len(recorder.frames) == 1
    with pytest.raises(InputError, match=r"Recorder.picture\(\): the recorder is closed"):
        recorder.take(data)


def test_a_renderer_is_found_without_a_setting(cell, monkeypatch):
    monkeypatch.delenv("MUJOCO_GL", raising=False)
    gl_context(16, 16).free()


@pytest.mark.parametrize("value, why", [("off", "MUJOCO_GL is off"), ("osmesa", "osmesa: no driver")])
def test_without_a_renderer_the_message_says_what_to_do(value, why, monkeypatch):
    def absent(name):
        raise ImportError("no driver")

    monkeypatch.setenv("MUJOCO_GL", value)
    monkeypatch.setattr(recording.importlib, "import_module", absent)
    with pytest.raises(InputError, match=rf"Recorder: nothing renders .*{why}.*libegl1.*MUJOCO_GL=egl.*clouds do not"):
        gl_context(16, 16)


@pytest.mark.parametrize("name, value", [("width", 0), ("height", 121), ("rate", 0), ("distance", -1), ("fovy", 180)])
def test_wrong_settings_are_refused(name, value):
    model = mujoco.MjModel.from_xml_string("<mujoco/>")
    with pytest.raises(InputError, match=f"Recorder: {name} is {value}"):
        Recorder(model, **{name: value})
