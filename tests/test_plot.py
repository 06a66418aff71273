"""`tdf.plot` and how objects show themselves in a notebook."""

import base64
import html
import io
import re

import jax
import matplotlib
import numpy as np
import pytest
from conftest import CARRY, colours_of, page_content, random_cloud
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

import tdf_jax as tdf
from tdf_jax._internal.errors import InputError
from tdf_jax.geometry.grid import plane_grid, volume_grid
from tdf_jax.landscape.storage import Landscape
from tdf_jax.viz import cards

CLOUD = random_cloud(3).astype(np.float32)


@pytest.fixture(scope="module")
def result(field, reference):
    return tdf.carry(field, reference, jax.random.key(0), config=CARRY)


def bowl(grid):
    values = 0.002 + np.linalg.norm(grid.points, axis=-1)[None]
    return Landscape(grid, values, np.zeros((1, 3)), np.eye(3)[None], np.zeros(values.shape, np.int32))


def drawn(figure):
    """The figure as a PNG: it draws without an error, and is not blank."""
    content = io.BytesIO()
    FigureCanvasAgg(figure)
    figure.savefig(content, format="png", dpi=60)
    assert colours_of(content.getvalue()) > 50
    return content.getvalue()


def axes(kind):
    figure = Figure()
    return figure.add_subplot(projection="3d" if kind == 3 else None)


CALLS = {
    "imitation": (3, lambda w, **o: tdf.plot.imitation(w["demonstration"], CLOUD, w["result"], **o)),
    "losses": (2, lambda w, **o: tdf.plot.losses(w["result"], **o)),
    "candidates": (3, lambda w, **o: tdf.plot.candidates(w["result"], CLOUD, w["demonstration"].query, **o)),
    "landscape": (2, lambda w, **o: tdf.plot.landscape(bowl(plane_grid(0.2, 5)), CLOUD, **o)),
    "reconstruction": (3, lambda w, **o: tdf.plot.reconstruction(w["field"], CLOUD, **o)),
}


def test_every_function_has_a_call():
    assert sorted([*CALLS, "page"]) == tdf.plot.__all__


def test_another_candidate_is_drawn(demonstration, result):
    """Its path is the line of the new object."""
    worst = int(np.argmax(result.energies))
    mine = axes(3)
    tdf.plot.imitation(demonstration, CLOUD, result, candidate=worst, ax=mine)
    (path,) = [line for line in mine.lines if line.get_label() == "trajectory of the query frame"]
    np.testing.assert_allclose(np.array(path.get_data_3d()).T, 100 * result.trajectories[worst][:, 4:], rtol=1e-5)
    with pytest.raises(
        InputError, match=f"candidate is 3; expected a whole number from 0 to {len(result.energies) - 1}"
    ):
        tdf.plot.imitation(demonstration, CLOUD, result, candidate=3)


def test_a_page_shows_itself_in_a_cell_and_is_saved(demonstration, result, tmp_path):
    """The cell holds the same page as the file, as a page within the page."""
    pytest.importorskip("plotly")
    scene = tdf.ImitationScene(demonstration, CLOUD, result)
    page = tdf.plot.page(scene, title="Two <mugs>")
    page.save(tmp_path / "it.html")
    text = (tmp_path / "it.html").read_text()
    cell = page._repr_html_()
    assert cell.startswith("<iframe srcdoc=") and html.unescape(cell.split('"')[1]) == text
    assert "Two &lt;mugs&gt;" in text and len(repr(page)) < 100
    flat = tdf.plot.page(bowl(plane_grid(0.2, 5)), points=CLOUD)
    assert {one["type"] for one in page_content(flat.text)["data"]} >= {"surface", "scatter3d"}
    with pytest.raises(InputError, match="an ImitationScene has its own: drop them"):
        tdf.plot.page(scene, points=CLOUD)
    with pytest.raises(InputError, match=r"plot.page\(\): got a Result; expected an ImitationScene or a Landscape"):
        tdf.plot.page(result)


@pytest.mark.slow
def test_a_page_plays_in_a_cell(demonstration, result, browser):
    pytest.importorskip("plotly")
    tab = browser.new_page(viewport={"width": 1000, "height": 700})
    tab.context.set_offline(True)
    tab.set_content(tdf.plot.page(tdf.ImitationScene(demonstration, CLOUD, result))._repr_html_())
    frame = tab.frame_locator("iframe")
    frame.locator("body[data-ready]").wait_for(timeout=60_000)
    assert colours_of(tab.screenshot()) > 100
    frame.get_by_role("button", name="Play").click()
    last = 6 * (max(demonstration.trajectory.num_poses, len(result.trajectory.wxyz_xyz)) - 1)
    frame.locator(f'body[data-frame="{last}"]').wait_for(timeout=60_000)
    tab.close()


@pytest.mark.parametrize("name", CALLS)
def test_a_picture_is_a_figure_and_can_be_a_panel_of_another(name, demonstration, field, result, monkeypatch):
    if name == "reconstruction":
        pytest.importorskip("igl")
        monkeypatch.setattr("tdf_jax.networks.surface.CELLS", 12)
    kind, call = CALLS[name]
    world = {"demonstration": demonstration, "field": field, "result": result}
    figure = call(world)
    assert isinstance(figure, Figure)
    drawn(figure)
    labels = [axis.get_label_text() for one in figure.axes for axis in one._axis_map.values()]
    assert any("(cm)" in label or "no unit" in label for label in labels)
    mine = axes(kind)
    assert call(world, ax=mine) is mine.figure
    assert mine.has_data()
    drawn(mine.figure)
    with pytest.raises(InputError, match="ax is .*; expected"):
        call(world, ax=axes(5 - kind))
    assert "font.size" in matplotlib.rcParams and matplotlib.rcParams["font.size"] == 10  # the caller's style stays


def test_losses_end_at_the_energies(result):
    (curves,) = tdf.plot.losses(result).axes
    ends = sorted(line.get_ydata()[-1] for line in curves.lines)
    np.testing.assert_allclose(ends, np.sort(result.energies), rtol=1e-6)


def test_the_best_is_the_darkest_box_and_the_scale_has_all_energies(demonstration, result):
    figure = tdf.plot.candidates(result, CLOUD, demonstration.query)
    modes = tdf.cluster_poses(result.picks, result.energies)
    low, high = figure.axes[1].get_xlim()
    assert low == pytest.approx(modes[0].energy) and high >= modes[-1].energy * (1 - 1e-6)
    assert f"{len(modes)} distinct picks" in figure.axes[1].get_xlabel()


def test_what_cannot_be_drawn_is_refused(demonstration, result):
    batch = jax.tree.map(lambda x: np.stack([np.asarray(x)] * 2), result)
    for call in (
        lambda: tdf.plot.losses(batch),
        lambda: tdf.plot.imitation(demonstration, CLOUD, batch),
        lambda: tdf.plot.candidates(batch, CLOUD, demonstration.query),
    ):
        with pytest.raises(InputError, match=r"the result is a batch of shape \(2, 3\); expected one"):
            call()
    with pytest.raises(InputError, match="result is a Trajectory; expected the Result of a solver"):
        tdf.plot.losses(result.trajectory)
    with pytest.raises(InputError, match="ax is given, and the grid has 3 axes"):
        tdf.plot.landscape(bowl(volume_grid(0.1, 3)), CLOUD, ax=axes(2))
    with pytest.raises(InputError, match=r"points has shape \(40, 2\)"):
        tdf.plot.candidates(result, CLOUD[:, :2], demonstration.query)


def shown(value):
    """The table and the picture of what shows itself."""
    page = value._repr_html_()
    (picture,) = re.findall(r"base64,([^']+)'", page)
    assert colours_of(base64.b64decode(picture)) > 20
    return dict(re.findall(r"<th[^>]*>([^<]+)</th><td[^>]*>([^<]+)</td>", page))


def test_objects_show_a_table_and_a_picture(demonstration, result, small_model):
    length = 100 * np.linalg.norm(np.diff(demonstration.trajectory.translations, axis=0), axis=1).sum()
    assert f"{length:.1f} cm long" in shown(demonstration.trajectory)["path"]
    rows = shown(demonstration)
    assert rows["object"].startswith("40 points") and rows["grasp, release"] == "pose 0, pose 3"
    assert rows["target"] == "none" and rows["query points"].startswith("8 in")
    assert shown(result)["loss"].startswith(f"{result.loss:.5f}")
    energies = bowl(plane_grid(0.2, 5))
    rows = shown(energies)
    assert rows["grid"] == "5 x 5 points, 10, 10 cm apart"
    assert rows["energy"].startswith(f"{energies.combined.min():.5f} to {energies.combined.max():.5f}")
    assert shown(bowl(volume_grid(0.2, 4)))["grid"].startswith("4 x 4 x 4 points")
    count = sum(leaf.size for leaf in jax.tree.leaves(small_model.params))
    assert shown(small_model)["parameters"] == f"{count:,}"


def test_what_is_traced_or_fails_to_draw_shows_its_text(demonstration, monkeypatch):
    kept = []
    jax.jit(lambda path: kept.append(path._repr_html_()) or path.wxyz_xyz)(demonstration.trajectory)
    assert kept == [None]

    def broken(*_, **__):
        raise RuntimeError("no canvas")

    monkeypatch.setattr(cards, "axes3d", broken)
    page = demonstration._repr_html_()
    assert page.startswith("<table>") and "img" not in page
