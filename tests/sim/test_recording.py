"""Pictures and films of a cell: what they show, when they are taken, and the files."""

import importlib

import numpy as np
import pytest
from PIL import Image

from tdf_jax._internal.errors import InputError
from tdf_jax.sim import recording
from tdf_jax.sim.recording import Recorder, gl_context, save_film, write_frame

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


def pictures(count=6):
    """Squares that move, of a few colours, (count, 40, 60, 3)."""
    frames = np.full((count, 40, 60, 3), (200, 210, 220), np.uint8)
    for number, frame in enumerate(frames):
        frame[10:20, 5 * number : 5 * number + 10] = (220, 40, 30)
    return list(frames)


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
    monkeypatch.setattr(Recorder, "picture", lambda self, data: times.append(data.time) or pictures(1)[0])
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


@pytest.mark.parametrize("rate", [10, 30])
def test_a_gif_plays_the_pictures_at_their_rate(rate, tmp_path):
    frames = pictures()
    save_film(tmp_path / "film.gif", frames, rate)
    with Image.open(tmp_path / "film.gif") as film:
        assert film.size == (60, 40) and film.n_frames == 6
        durations = []
        for number, frame in enumerate(frames):
            film.seek(number)
            durations.append(film.info["duration"])
            assert np.abs(np.asarray(film.convert("RGB"), int) - frame).max() < 12  # the palette's
        assert film.info["loop"] == 0
    assert sum(durations) == pytest.approx(6000 / rate, abs=5)


def test_an_mp4_has_the_pictures(tmp_path):
    ffmpeg = pytest.importorskip("imageio_ffmpeg", reason="MP4 NOT CHECKED: imageio-ffmpeg is not installed")
    frames = [np.kron(frame, np.ones((4, 4, 1), np.uint8)) for frame in pictures()]
    save_film(tmp_path / "film.mp4", frames, 20)
    read = ffmpeg.read_frames(str(tmp_path / "film.mp4"))
    about = next(read)
    assert about["size"] == (240, 160) and about["fps"] == 20
    shown = [np.frombuffer(frame, np.uint8).reshape(160, 240, 3) for frame in read]
    assert len(shown) == 6
    assert np.abs(shown[3].astype(int) - frames[3]).mean() < 10


def test_an_mp4_without_its_package_is_refused(tmp_path, monkeypatch):
    load = importlib.import_module

    def absent(name, *about):
        if name == "imageio_ffmpeg":
            raise ImportError(name)
        return load(name, *about)

    monkeypatch.setattr(recording.importlib, "import_module", absent)
    with pytest.raises(InputError, match="pip install imageio-ffmpeg"):
        save_film(tmp_path / "film.mp4", pictures())
    assert list(tmp_path.iterdir()) == []


def test_a_frame_is_written_as_it_is(tmp_path):
    picture = np.random.default_rng(0).integers(0, 256, (12, 20, 3), np.uint8)
    write_frame(tmp_path / "frame.png", picture)
    with Image.open(tmp_path / "frame.png") as image:
        np.testing.assert_array_equal(np.asarray(image), picture)


@pytest.mark.parametrize(
    "call, message",
    [
        (lambda folder: save_film(folder / "film.avi", pictures()), "expected a name that ends in .gif or .mp4"),
        (lambda folder: save_film(folder / "film.gif", []), "there are no pictures"),
        (lambda folder: save_film(folder / "film.gif", pictures(), 60), "rate is 60"),
        (lambda folder: save_film(folder / "no" / "film.gif", pictures()), "cannot write"),
        (lambda folder: save_film(folder / "film.gif", [*pictures(1), np.zeros((4, 4, 3), np.uint8)]), "several sizes"),
        (lambda folder: write_frame(folder / "frame.jpg", pictures(1)[0]), "ends in .png"),
        (lambda folder: write_frame(folder / "frame.png", np.zeros((4, 4, 3))), "got a picture of float64"),
    ],
)
def test_wrong_films_are_refused(call, message, tmp_path):
    with pytest.raises(InputError, match=message):
        call(tmp_path)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("name, value", [("width", 0), ("height", 121), ("rate", 0), ("distance", -1), ("fovy", 180)])
def test_wrong_settings_are_refused(name, value):
    model = mujoco.MjModel.from_xml_string("<mujoco/>")
    with pytest.raises(InputError, match=f"Recorder: {name} is {value}"):
        Recorder(model, **{name: value})
