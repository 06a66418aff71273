"""Pictures of failed episodes: which are drawn, and that they show what failed."""

import io
from pathlib import Path

import numpy as np
import pytest
from conftest import lifted, short_playback
from PIL import Image

from tdf_jax._internal.errors import InputError
from tdf_jax.sim import failures
from tdf_jax.sim.campaign import Run
from tdf_jax.sim.condition import Condition, Settings
from tdf_jax.sim.episode import Outcome
from tdf_jax.sim.failures import check_renderer, failure_sheet, first_failures, picture_one
from tdf_jax.sim.imitator import Found

SHELF = Condition("bowl_on_shelf", "known", "upright", "execute")
GOOD = Outcome(True, True, True, True, "", "", 0.0, 0.0)


def run(number, cause, condition=SHELF, grasp=True):
    outcome = Outcome(grasp, False, False, False, cause, "because", 0.0, 0.0) if cause else GOOD
    return Run(condition, number, outcome, 0, 0, (0.0, 0.0, 0.0))


def named(name="bowl", folder=Path()):
    return Settings(SHELF, name, None, 0, folder)


def test_the_first_of_each_cause_is_drawn():
    rows = [
        (named("first"), [run(0, ""), run(1, "fell"), run(2, "not found"), run(3, "fell"), run(4, "not drawn")]),
        (named("second"), [run(0, "fell"), run(1, "collided")]),
    ]
    found = [(settings.object_weights, one.number, one.outcome.cause) for settings, one in first_failures(rows)]
    assert found == [("first", 1, "fell"), ("second", 1, "collided")]


@pytest.fixture
def renderer():
    try:
        check_renderer()
    except InputError as error:  # without EGL or OSMesa there is nothing to test, and the message says so
        pytest.skip(f"PICTURES NOT CHECKED: {error}")


def pick_beside(episode):
    pick = episode.pick.copy()
    pick[0, 3] += 0.1
    return pick


@pytest.mark.slow
@pytest.mark.parametrize(
    ("mode", "cause", "grasp"),
    [
        ("teleport", "slipped", False),
        ("teleport", "fell", True),
        ("execute", "unreachable", False),
        ("execute", "fell", True),
    ],
)
def test_a_picture_has_two_views_of_the_failure(robot, drawn, renderer, monkeypatch, tmp_path, mode, cause, grasp):
    episode = drawn("bowl_on_shelf")
    release = episode.release.copy()
    release[1, 3] -= 0.22
    if cause == "unreachable":
        release[0, 3] += 3
    path = lifted(pick_beside(episode) if cause == "slipped" else episode.pick, release, 0.2)
    found = Found(
        path[None], np.array([episode.grip.opening]), path[-1] @ np.linalg.inv(path[0]), "", 0.0, np.zeros((0, 3))
    )
    monkeypatch.setattr(failures, "found_in", lambda settings, number: (episode, robot, found))
    settings = Settings(SHELF._replace(mode=mode), "bowl", None, 0, tmp_path)
    pixels = picture_one(settings, run(7, cause, settings.condition, grasp))
    height = len(pixels) - failures.HEIGHT
    assert pixels.shape[1] == 2 * failures.WIDTH and pixels[:height].min() < 100  # words above
    left, right = pixels[height:, : failures.WIDTH], pixels[height:, failures.WIDTH :]
    assert np.abs(left.astype(int) - right).mean() > 1  # two moments, or two poses
    red, _, blue = np.moveaxis(left.astype(int), -1, 0)
    assert (red > blue + 60).sum() > 100  # the object is in the picture


def test_a_sheet_holds_all_pictures():
    pictures = [np.full((40, 60, 3), shade, np.uint8) for shade in (10, 90, 170)]
    with Image.open(io.BytesIO(failure_sheet(pictures))) as sheet:
        pixels = np.asarray(sheet.convert("L"))
    assert pixels.shape == (80, 120)
    shades = [pixels[20, 30], pixels[20, 90], pixels[60, 30], pixels[60, 90]]
    np.testing.assert_allclose(shades, [10, 90, 170, 255], atol=4)


def test_without_a_renderer_one_line_says_so(monkeypatch, capsys, tmp_path):
    from tdf_jax.cli.episodes import draw_failures

    monkeypatch.setenv("MUJOCO_GL", "disable")
    monkeypatch.setattr(failures, "picture_failures", lambda failed: pytest.fail("it draws"))
    assert draw_failures("tdf simulate", [(named(), [run(0, "fell")])], tmp_path / "failures") is False
    out, error = capsys.readouterr()
    assert out == "" and len(error.splitlines()) == 1 and not (tmp_path / "failures").exists()
    assert error.startswith("tdf simulate: no pictures of failures: ") and "MUJOCO_GL is disable" in error
    assert draw_failures("tdf simulate", [(named(), [run(0, "")])], tmp_path / "failures") is False
    assert capsys.readouterr() == ("", "")


def test_pictures_and_their_sheet_are_written(monkeypatch, tmp_path):
    from tdf_jax.cli.episodes import draw_failures

    monkeypatch.setattr(failures, "check_renderer", lambda: None)
    monkeypatch.setattr(failures, "picture_failures", lambda failed: [np.zeros((8, 8, 3), np.uint8) for _ in failed])
    rows = [(named(), [run(3, "fell"), run(5, "not settled")])]
    assert draw_failures("tdf simulate", rows, tmp_path / "failures") is True
    assert sorted(one.name for one in (tmp_path / "failures").iterdir()) == [
        "bowl_on_shelf-execute-known-upright-3-fell.png",
        "bowl_on_shelf-execute-known-upright-5-not_settled.png",
        "failures.png",
    ]


def test_a_page_of_each_failure_stands_beside_its_picture(monkeypatch, tmp_path, capsys):
    """Pages need no renderer, and what was not kept ends no command."""
    from tdf_jax.cli.episodes import draw_failures
    from tdf_jax.cli.pictures import PictureError
    from tdf_jax.sim.campaign import about_episode
    from tdf_jax.sim.playback import FOLDER, save_playback

    pytest.importorskip("plotly")
    monkeypatch.setenv("MUJOCO_GL", "disable")
    settings = named(folder=tmp_path)
    rows = [(settings, [run(3, "fell"), run(5, "not settled")])]
    save_playback("test", tmp_path / FOLDER, "it", short_playback(about_episode(settings, 3)))
    with pytest.raises(PictureError, match=r"5-not_settled.html is missing .*episode 5 is not kept to look at"):
        draw_failures("tdf simulate", rows, tmp_path / "failures", page=True)
    assert [one.name for one in (tmp_path / "failures").iterdir()] == [
        "bowl_on_shelf-execute-known-upright-3-fell.html"
    ]
    assert "no pictures of failures" in capsys.readouterr().err
