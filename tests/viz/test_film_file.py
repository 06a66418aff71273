"""Films and frames as files."""

import importlib
import subprocess

import numpy as np
import pytest
from PIL import Image

from tdf_jax._internal.errors import InputError
from tdf_jax.viz import film_file
from tdf_jax.viz.film_file import save_film, write_frame


def pictures(count=6):
    """Squares that move, of a few colours, (count, 40, 60, 3)."""
    frames = np.full((count, 40, 60, 3), (200, 210, 220), np.uint8)
    for number, frame in enumerate(frames):
        frame[10:20, 5 * number : 5 * number + 10] = (220, 40, 30)
    return list(frames)


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
    ffmpeg = pytest.importorskip("imageio_ffmpeg", reason="MP4 NOT CHECKED: the extra 'films' is not installed")
    frames = [np.kron(frame, np.ones((4, 4, 1), np.uint8)) for frame in pictures()]
    save_film(tmp_path / "film.mp4", frames, 20)
    command = [ffmpeg.get_ffmpeg_exe(), "-i", str(tmp_path / "film.mp4"), "-f", "rawvideo", "-pix_fmt", "rgb24", "-"]
    read = subprocess.run(command, capture_output=True, check=True)  # its reader forks, of which JAX warns
    assert b"240x160" in read.stderr and b"20 fps" in read.stderr and b"h264" in read.stderr
    shown = np.frombuffer(read.stdout, np.uint8).reshape(-1, 160, 240, 3)
    assert len(shown) == 6
    assert np.abs(shown[3].astype(int) - frames[3]).mean() < 10


def test_an_encoder_that_fails_says_why(tmp_path):
    pytest.importorskip("imageio_ffmpeg", reason="MP4 NOT CHECKED: the extra 'films' is not installed")
    with pytest.raises(InputError, match="the encoder failed .*not divisible by 2"):
        save_film(tmp_path / "film.mp4", [np.zeros((41, 61, 3), np.uint8)])
    assert list(tmp_path.iterdir()) == []


def test_an_mp4_without_its_package_is_refused(tmp_path, monkeypatch):
    load = importlib.import_module

    def absent(name, *about):
        if name == "imageio_ffmpeg":
            raise ImportError(name)
        return load(name, *about)

    monkeypatch.setattr(film_file.importlib, "import_module", absent)
    with pytest.raises(InputError, match=r"pip install 'tdf_jax\[films\]'"):
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
