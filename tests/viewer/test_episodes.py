"""Simulated episodes in the viewer: which is shown, and where its bodies are at every time."""

import time

import numpy as np
import pytest
from conftest import colours_of, short_playback

import tdf_jax as tdf
from tdf_jax.sim.playback import FOLDER, save_playback
from tdf_jax.sim.workcell import OBJECT
from tdf_jax.viewer import episodes
from tdf_jax.viewer.local_server import address, serving

pytest.importorskip("viser", reason="the extra 'viewer' is not installed")
SECONDS = 120


@pytest.fixture
def folder(tmp_path):
    save_playback("test", tmp_path / FOLDER, "a", short_playback(number=3))
    failed = short_playback(number=4, cause="fell", detail="it touches the table", slip=None)
    save_playback("test", tmp_path / FOLDER, "b", failed)
    return tmp_path


@pytest.fixture
def shown(folder):
    with serving("test", 0) as server:
        one = episodes.EpisodeStage(server, folder)
        yield one
        one.close()


def test_bodies_move_with_the_time_and_vanish_where_they_are_not(shown):
    assert shown.frame == 0 and shown._phase.content == "0.00 s: path"
    np.testing.assert_allclose(shown._bodies[OBJECT].position, [0.4, 0.1, 0.05], atol=1e-4)
    shown.player.value = shown.playback.times[-1]
    shown._show_time()
    np.testing.assert_allclose(shown._bodies[OBJECT].position, [0.5, -0.2, -0.5], atol=1e-4)
    assert shown._phase.content == "0.10 s: settling"
    assert not shown._bodies["robot/link"].visible and shown._bodies[OBJECT].visible
    shown._switch("object", False)
    assert not shown._bodies[OBJECT].visible
    shown.player.value = 0.0
    shown._show_time()
    assert shown._bodies["robot/link"].visible and not shown._bodies[OBJECT].visible


def test_another_episode_is_shown_with_what_became_of_it(shown):
    assert "**Success**" in shown._verdict.content and "moved by 2.0 mm and 1.5°" in shown._verdict.content
    assert shown._counts.content == "2 episodes, 1 successes; failures: 1 fell."
    shown.show(1)
    assert shown.playback.about["number"] == 4
    assert "**Failure: fell**" in shown._verdict.content and "it touches the table" in shown._verdict.content
    assert "In the hand" not in shown._verdict.content
    shown._narrow(episodes.FAILURES)
    assert shown._choice.options == ("2: fell (bowl_on_shelf 4, execute)",)


def test_playing_ends_at_the_last_frame(shown):
    shown.player.start()
    until = time.monotonic() + SECONDS
    while shown.player.playing and time.monotonic() < until:
        time.sleep(0.01)
    assert shown.frame == len(shown.playback.times) - 1


def test_the_number_of_an_episode_is_that_of_the_campaign(folder):
    with serving("test", 0) as server:
        assert episodes.EpisodeStage(server, folder, 4).playback.about["cause"] == "fell"
        with pytest.raises(tdf.InputError, match="there is no episode 7 in .*; expected one of 3, 4"):
            episodes.EpisodeStage(server, folder, 7)
        (folder / "other" / FOLDER).mkdir(parents=True)
        with pytest.raises(tdf.InputError, match="keeps outcomes, but no episode to show"):
            episodes.EpisodeStage(server, folder / "other")


@pytest.mark.slow
def test_a_browser_draws_an_episode_plays_it_and_saves_its_page(shown, browser, tmp_path):
    pytest.importorskip("plotly")
    tab = browser.new_page(viewport={"width": 1000, "height": 700})
    tab.goto(address(shown.server))
    tab.wait_for_selector("canvas", timeout=1000 * SECONDS)
    tab.wait_for_selector("text=0.00 s: path", timeout=1000 * SECONDS)
    tab.wait_for_timeout(3000)
    before = tab.screenshot()
    assert colours_of(before) > 300
    tab.click("button:has-text('Play')")
    tab.wait_for_selector("text=0.10 s: settling", timeout=1000 * SECONDS)
    tab.wait_for_timeout(1000)
    assert tab.screenshot() != before
    with tab.expect_download(timeout=1000 * SECONDS) as download:
        tab.click("button:has-text('Save as a page')")
        tab.click("text=a.html", timeout=1000 * SECONDS)
    download.value.save_as(tmp_path / "saved.html")
    assert "bowl_on_shelf, episode 3" in (tmp_path / "saved.html").read_text()
    tab.close()
