"""Pictures of landscapes: that each shows what it should, and refuses what it cannot show."""

import dataclasses

import numpy as np
import pytest
from conftest import page_content
from PIL import Image, ImageSequence

import tdf_jax as tdf
from tdf_jax._internal.errors import InputError
from tdf_jax.geometry.grid import Grid, plane_grid, volume_grid
from tdf_jax.landscape.storage import Landscape
from tdf_jax.viz import landscapes as terrain
from tdf_jax.viz.landscape_page import save_landscape_page

WAYPOINTS = np.array([[0.0, 0, 0], [0.1, 0.05, 0.1]])
POINTS = np.random.default_rng(0).normal(size=(300, 3)) * 0.03


def bowl(grid):
    """Each waypoint's energy grows with the distance from it."""
    values = 0.002 + 0.05 * np.linalg.norm(grid.points[None] - WAYPOINTS.reshape(2, *[1] * len(grid.shape), 3), axis=-1)
    return Landscape(grid, values, WAYPOINTS, np.eye(3)[None], np.zeros(values.shape, np.int32))


@pytest.fixture
def marks():
    return terrain.Marks(POINTS, expected=WAYPOINTS + 0.01, path=WAYPOINTS)


def test_a_map_shows_every_waypoints_energy_and_minimiser_in_centimetres(marks):
    landscape = bowl(plane_grid(0.2, 9, axes="xz"))
    figure = terrain.map_figure(landscape, marks, "over it")
    panels = [axes for axes in figure.axes if axes.get_title()]
    assert [axes.get_title() for axes in panels] == ["all waypoints", "waypoint 0", "waypoint 1"]
    for axes, energy in zip(panels, [landscape.combined, *landscape.values]):
        np.testing.assert_allclose(axes.collections[0].get_array().reshape(9, 9), energy.T)
        assert axes.get_xlim() == (-20, 20)
    assert panels[0].get_xlabel().startswith("x ") and panels[0].get_ylabel().startswith("z ")
    crosses = [[line for line in axes.lines if line.get_marker() == "x"] for axes in panels]
    assert [[len(line.get_xdata()) for line in lines] for lines in crosses] == [[2], [1], [1]]
    np.testing.assert_allclose(crosses[2][0].get_xydata(), [[10, 10]])
    words = {text.get_text() for text in figure.legends[0].get_texts()}
    assert {"true waypoints", "lowest-cost path", "waypoints' minimisers"} <= words


def test_axes_are_named_by_their_direction():
    turned = np.array([[0.0, -1, 0], [0.6, 0, 0.8]])
    figure = terrain.map_figure(bowl(plane_grid(0.2, 5, axes=turned)), terrain.Marks(POINTS))
    assert figure.axes[0].get_ylabel().startswith("along (0.60, 0.00, 0.80)")
    assert figure.axes[2].get_xlabel().startswith("-y ")


@pytest.mark.parametrize("axes", [None, tdf.rotation_grid(3)[2].astype(float)])
def test_an_isosurface_lies_where_the_energy_has_its_value(axes):
    """Of a bowl about one point: a sphere, whatever the order and number of the grid's axes."""
    coordinates = (np.linspace(-0.2, 0.2, 21), np.linspace(-0.15, 0.15, 31), np.linspace(-0.1, 0.15, 26))
    landscape = bowl(Grid(np.array([0.0, 0.01, 0.0]), np.eye(3) if axes is None else axes, coordinates))
    landscape = dataclasses.replace(
        landscape, values=landscape.values[:1], waypoints=WAYPOINTS[:1], turned=landscape.turned[:1]
    )
    triangles = terrain.isosurface(landscape, 0.02)
    radii = np.linalg.norm(triangles.reshape(-1, 3), axis=1)
    level = np.quantile(landscape.combined, 0.02)
    np.testing.assert_allclose(radii, (level - 0.002) / 0.05, atol=0.002)
    assert len(triangles) > 50


def test_a_volume_is_drawn_with_its_object(marks):
    landscape = bowl(volume_grid(0.2, 9))
    mesh = tdf.build_mug().mesh
    for one in (marks, dataclasses.replace(marks, mesh=mesh)):
        figure = terrain.isosurface_figure(landscape, one)
        (axes,) = figure.axes
        pieces = [item for item in axes.collections if hasattr(item, "set_3d_properties")]
        assert pieces
        assert {"least 2 % of the volume", "lowest-cost path"} <= {
            text.get_text() for text in figure.legends[0].get_texts()
        }


def test_slices_go_through_the_volume(tmp_path, marks):
    landscape = bowl(volume_grid(0.2, 5))
    terrain.save_slices(tmp_path / "it.gif", landscape, marks)
    assert [file.name for file in tmp_path.iterdir()] == ["it.gif"]
    with Image.open(tmp_path / "it.gif") as picture:
        frames = [np.asarray(frame.convert("RGB"), int) for frame in ImageSequence.Iterator(picture)]
    assert len(frames) == 5
    assert all(np.abs(a - b).max() > 50 for a, b in zip(frames, frames[1:]))
    with pytest.raises(InputError, match="cannot write"):
        terrain.save_slices(tmp_path / "no folder" / "it.gif", landscape, marks)


@pytest.mark.slow
@pytest.mark.parametrize("axes", [2, 3])
@pytest.mark.parametrize("masked", [False, True])
def test_a_page_needs_no_network(tmp_path, marks, axes, masked):
    grid = plane_grid(0.2, 5) if axes == 2 else volume_grid(0.2, 5)
    landscape = bowl(grid)
    if masked:
        landscape.values[:, 0] = np.nan
    one = dataclasses.replace(marks, mesh=tdf.build_mug().mesh) if axes == 3 else marks
    save_landscape_page(tmp_path / "it.html", landscape, one, "A title")
    page = (tmp_path / "it.html").read_text()
    assert "<script src=" not in page and 'src="http' not in page
    assert len(page) < 5_000_000
    names = [one["name"] for one in page_content(page)["data"]]
    assert "A title" in page and "lowest-cost path" in names
    assert any("least 2 %" in name for name in names) == (axes == 3)
    assert ("energy" in names) == (axes == 2)
    with pytest.raises(InputError, match="cannot write"):
        save_landscape_page(tmp_path / "no folder" / "it.html", landscape, one)


def test_a_map_of_many_waypoints_shows_some():
    landscape = bowl(plane_grid(0.2, 4))
    many = {"values": np.repeat(landscape.values, 50, axis=0), "turned": np.repeat(landscape.turned, 50, axis=0)}
    figure = terrain.map_figure(
        dataclasses.replace(landscape, **many, waypoints=np.repeat(WAYPOINTS, 50, axis=0)), terrain.Marks(POINTS)
    )
    titles = [axes.get_title() for axes in figure.axes if axes.get_title()]
    assert len(titles) == 1 + terrain.MAX_PANELS
    assert titles[1] == "waypoint 0" and titles[-1] == "waypoint 99"


def test_what_cannot_be_shown_is_refused(tmp_path, marks, monkeypatch):
    plane, volume = bowl(plane_grid(0.2, 5)), bowl(volume_grid(0.2, 5))
    with pytest.raises(InputError, match=r"map_figure\(\): the grid has 3 axes; expected 2"):
        terrain.map_figure(volume, marks)
    with pytest.raises(InputError, match=r"isosurface_figure\(\): the grid has 2 axes; expected 3"):
        terrain.isosurface_figure(plane, marks)
    with pytest.raises(InputError, match="2 axes; expected 3"):
        terrain.save_slices(tmp_path / "it.gif", plane, marks)
    each = dataclasses.replace(plane, values=plane.values[:, None], turned=None)
    with pytest.raises(InputError, match="every rotation"):
        terrain.map_figure(each, marks)
    monkeypatch.setitem(__import__("sys").modules, "plotly.graph_objects", None)
    with pytest.raises(InputError, match="pip install"):
        save_landscape_page(tmp_path / "it.html", plane, marks)
    assert not list(tmp_path.iterdir())
