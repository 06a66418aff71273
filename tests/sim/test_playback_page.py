"""The page of an episode: it is small, needs no network, and moves every body as it moved."""

import numpy as np
import pytest
from conftest import colours_of, opened, page_content, short_playback

from tdf_jax._internal.errors import InputError
from tdf_jax.sim.playback_page import save_playback_page

pytest.importorskip("plotly")


@pytest.fixture(scope="module")
def page(tmp_path_factory):
    path = tmp_path_factory.mktemp("page") / "episode.html"
    save_playback_page(path, short_playback(cause="fell", detail="it touches the <table>"))
    return path


def test_it_says_what_became_of_the_episode_and_needs_no_network(page):
    text = page.read_text()
    assert len(text) < 5_000_000 and "http" not in text.split('id="plotly"')[0]
    assert "Fell: it touches the &lt;table&gt;." in text and "bowl_on_shelf, episode 3, execute" in text
    content = page_content(text)
    names = [one["name"] for one in content["data"]]
    assert names[:4] == ["robot", "object", "target", "table"] and "imitated path of the gripper" in names
    assert content["labels"] == ["0.0 s, path", "0.1 s, settling"] and content["rate"] == 10


def test_every_body_is_where_it_was(page):
    content = page_content(page.read_text())
    shown = short_playback()
    assert [one["trace"] for one in content["moving"]] == [0, 1]  # the target and the table stay
    (part,) = content["moving"][1]["parts"]
    for frame, moment in enumerate((0, 2)):
        R, t = (np.array(one) for one in part["motions"][frame])
        expected = 100 * (shown.solids[1].vertices + shown.wxyz_xyz[moment, 1, 4:])
        np.testing.assert_allclose((R @ np.array(part["points"])).T + t, expected, atol=0.02)
    (part,) = content["moving"][0]["parts"]
    assert np.abs(part["motions"][1][0]).max() == 0  # what is not there any more is a point
    drawn = content["data"][0]
    np.testing.assert_allclose(np.ptp(drawn["x"]), 10, atol=0.02)


def test_the_room_of_the_page_holds_what_moves_but_not_what_falls_from_the_table(page):
    scene = page_content(page.read_text())["layout"]["scene"]
    assert scene["zaxis"]["range"][0] > -25 and scene["zaxis"]["range"][1] > 55
    assert scene["zaxis"]["title"]["text"] == "z (cm)"


def test_without_plotly_it_is_refused(tmp_path, monkeypatch):
    monkeypatch.setitem(__import__("sys").modules, "plotly.graph_objects", None)
    with pytest.raises(InputError, match=r"plotly is not installed; .*pip install 'tdf_jax\[pages\]'"):
        save_playback_page(tmp_path / "it.html", short_playback())


@pytest.mark.slow
def test_a_browser_without_a_network_draws_and_plays_it(page, browser):
    tab, errors = opened(browser, page)
    before = tab.screenshot()
    assert colours_of(before) > 300
    tab.click("#play")
    tab.wait_for_function("document.body.dataset.frame === '1'", timeout=60_000)
    tab.wait_for_timeout(1000)
    assert tab.inner_text("#pose") == "0.1 s, settling" and tab.screenshot() != before and errors == []
    tab.close()
