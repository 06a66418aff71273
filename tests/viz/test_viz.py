import jax
import matplotlib
import matplotlib.pyplot
import numpy as np
import pytest

import tdf_jax as tdf
from tdf_jax._internal.errors import InputError
from tdf_jax.shapes import build_mug
from tdf_jax.viz import polygons3d
from tdf_jax.viz.imitation import imitation_figure, loss_figure
from tdf_jax.viz.style import save_figure


@pytest.fixture(scope="module")
def demonstration():
    points = np.random.default_rng(0).uniform(-0.05, 0.05, (40, 3)).astype(np.float32)
    return tdf.Demonstration(points, tdf.wave(num_poses=5), tdf.box_query(jax.random.key(0), 30, 0.06))


def lines(axes):
    return {line.get_label(): np.column_stack(line.get_data_3d()) for line in axes.lines}


@pytest.fixture
def drawn(monkeypatch):
    """The solid things of each 3-D view, in order."""
    views = []
    collection = polygons3d.Pieces.collection
    monkeypatch.setattr(polygons3d.Pieces, "collection", lambda pieces: views.append(pieces) or collection(pieces))
    return views


def test_both_sides_show_their_path_in_centimetres_at_one_scale(demonstration, drawn):
    found, truth = tdf.line(num_poses=5, end=(0.1, 0.3, 0.1)), tdf.semicircle(num_poses=5, end=(0.1, 0.3, 0.1))
    moved = demonstration.points + np.float32(1.0)
    figure = imitation_figure(demonstration, moved, found, truth, title="loss 0.1")
    left, right, bar = figure.axes
    assert figure.get_suptitle() == "loss 0.1"
    assert (left.get_title(), right.get_title()) == ("demonstration", "imitation")
    path, true_path = "trajectory of the query frame", "true trajectory and pick"
    np.testing.assert_allclose(lines(left)[path], 100 * demonstration.trajectory.translations, atol=1e-5)
    np.testing.assert_allclose(lines(right)[path], 100 * found.translations, atol=1e-5)
    np.testing.assert_allclose(lines(right)[true_path], 100 * truth.translations, atol=1e-5)
    assert true_path not in lines(left)
    labels = [text.get_text() for legend in figure.legends for text in legend.get_texts()]
    assert sorted(labels) == sorted(["object's points", path, true_path])
    spans = [[np.ptp(getattr(axes, f"get_{name}lim")()) for name in "xyz"] for axes in (left, right)]
    np.testing.assert_allclose(spans[0], spans[1], rtol=1e-6)
    for axes, pieces in zip((left, right), drawn, strict=True):
        np.testing.assert_allclose(axes._box_aspect / axes._box_aspect[0], np.array(spans[0]) / spans[0][0], rtol=1e-6)
        assert [getattr(axes, f"get_{name}label")() for name in "xyz"] == ["x (cm)", "y (cm)", "z (cm)"]
        for points in (np.concatenate(pieces.polygons), *lines(axes).values()):
            for name, column in zip("xyz", points.T):
                low, high = getattr(axes, f"get_{name}lim")()
                assert low <= column.min() and column.max() <= high
    assert [text.get_text() for text in bar.get_xticklabels()] == ["pick", "place"]


def test_boxes_bound_the_query_points_and_turn_with_the_poses(demonstration, drawn):
    turned = demonstration.trajectory.transformed(np.array([np.sqrt(0.5), 0, 0, np.sqrt(0.5), 0.2, 0, 0], np.float32))
    imitation_figure(demonstration, demonstration.points, turned)
    carried = np.einsum("nij,qj->nqi", turned.rotations, demonstration.query) + turned.translations[:, None]
    corners = np.concatenate(drawn[1].polygons)
    np.testing.assert_allclose(corners.min(axis=0), 100 * carried.min(axis=(0, 1)), atol=1e-3)
    np.testing.assert_allclose(corners.max(axis=0), 100 * carried.max(axis=(0, 1)), atol=1e-3)


def test_boxes_are_coloured_from_pick_to_place(demonstration, drawn):
    imitation_figure(demonstration, demonstration.points, demonstration.trajectory)
    colours = dict.fromkeys(tuple(colour[:3]) for colour in drawn[0].edges)
    np.testing.assert_allclose(list(colours), matplotlib.colormaps["viridis"](np.linspace(0, 1, 5))[:, :3])


def test_a_long_path_has_eight_boxes(demonstration, drawn):
    figure = imitation_figure(demonstration, demonstration.points, tdf.wave(num_poses=20))
    colours = dict.fromkeys(tuple(colour[:3]) for colour in drawn[1].edges)
    shares = np.round(np.linspace(0, 19, 8)) / 19
    np.testing.assert_allclose(list(colours), matplotlib.colormaps["viridis"](shares)[:, :3])
    assert [text.get_text() for text in figure.axes[2].get_xticklabels()] == ["pick", "place"]


def test_a_mesh_is_drawn_instead_of_the_points(demonstration, drawn):
    mesh = build_mug().mesh
    reference, test, _ = imitation_figure(
        demonstration, demonstration.points, demonstration.trajectory, meshes=(None, mesh)
    ).axes
    assert len(drawn[1].polygons) - len(drawn[0].polygons) == len(mesh.faces)
    labels = [[c.get_label() for c in axes.collections] for axes in (reference, test)]
    assert ["object's points" in names for names in labels] == [True, False]


def test_a_surface_is_lit_from_one_side_and_skips_faces_without_area():
    up, upright, flat = np.eye(3), np.array([[0, 0, 0], [1, 0, 0], [0, 0, 1]]), np.zeros((3, 3))
    pieces = polygons3d.surface(np.array([up, upright, flat], float), np.ones(3) / np.sqrt(3))
    assert len(pieces.polygons) == 2
    bright, dim = (np.array(colour[:3]) for colour in pieces.faces)
    np.testing.assert_allclose(bright, polygons3d.SURFACE_COLOUR)
    assert (dim < bright).all()


def test_a_box_is_twelve_edges_and_its_front():
    full, dashed = (
        polygons3d.box(polygons3d.CORNERS, "red"),
        polygons3d.box(polygons3d.CORNERS, "red", filled=False, dashed=True),
    )
    edges = [polygon for polygon in full.polygons if len(polygon) == 2]
    front = np.concatenate([polygon for polygon in full.polygons if len(polygon) == 4])
    assert sum(np.linalg.norm(b - a) for a, b in edges) == pytest.approx(12)
    assert sum(np.linalg.norm(b - a) for a, b in dashed.polygons) == pytest.approx(6)
    assert (front[:, 0] == 1).all() and front[:, 1:].min() == 0 and front[:, 1:].max() == 1


def test_every_start_is_a_line_and_the_best_is_bold():
    losses = np.array([[3.0, 2.0, 1.5], [3.0, 1.0, 0.5], [2.0, np.nan, np.nan]])
    (axes,) = loss_figure(losses, best=1).axes
    drawn = np.array([line.get_ydata() for line in axes.lines])
    np.testing.assert_array_equal(drawn, losses[[0, 2, 1]])
    assert [line.get_linewidth() > 1 for line in axes.lines] == [False, False, True]
    assert [text.get_text() for text in axes.get_legend().get_texts()] == ["other starts", "best, start 2 of 3"]
    assert (axes.get_xlabel(), axes.get_xlim(), axes.get_ylim()[0]) == ("step", (0, 2), 0)
    assert "loss" in axes.get_ylabel()


def test_a_figure_is_saved_without_touching_global_state(tmp_path):
    before, open_before = dict(matplotlib.rcParams), matplotlib.pyplot.get_fignums()
    save_figure(tmp_path / "loss.png", loss_figure(np.ones((1, 3)), best=0))
    assert (tmp_path / "loss.png").read_bytes().startswith(b"\x89PNG")
    assert dict(matplotlib.rcParams) == before
    assert matplotlib.pyplot.get_fignums() == open_before
    with pytest.raises(InputError, match="cannot write"):
        save_figure(tmp_path / "missing" / "loss.png", loss_figure(np.ones((1, 3)), best=0))
