"""Surfaces by marching cubes, and the pictures of an evaluation."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import trimesh
from scipy.spatial.transform import Rotation

from tdf_jax.networks import surface
from tdf_jax.networks.surface import surface_triangles
from tdf_jax.viz import reconstruction
from tdf_jax.viz.reconstruction import Panel, reconstruction_figure, transfer_figure


@functools.partial(jax.tree_util.register_dataclass, data_fields=["middle"], meta_fields=[])
@dataclasses.dataclass(frozen=True)
class Ellipsoid:
    """A field that is 0.5 on an ellipsoid with half axes of 5, 3 and 2 cm, turned by R in the world."""

    middle: jax.Array

    def occupancy(self, x):
        local = (x - self.middle) @ jnp.asarray(R, jnp.float32) / jnp.array([0.05, 0.03, 0.02])
        return jax.nn.sigmoid(20 * (1 - jnp.linalg.norm(local, axis=-1)))


R = Rotation.from_rotvec([0.5, -1.0, 0.7]).as_matrix()
BOUNDS = np.array([[-0.05, -0.03, -0.02], [0.05, 0.03, 0.02]])


@pytest.fixture
def coarse(monkeypatch):
    """Few cells and pieces: the same programs, quicker."""
    monkeypatch.setattr(surface, "CELLS", 30)
    monkeypatch.setattr(reconstruction, "PIECES", 4)


def test_the_surface_lies_where_the_occupancy_is_one_half(quick_compilation, coarse):
    pytest.importorskip("igl")
    T_world_object = np.eye(4)
    T_world_object[:3, :3], T_world_object[:3, 3] = R, [0.3, 0.2, -0.1]
    triangles = surface_triangles(Ellipsoid(jnp.array([0.3, 0.2, -0.1])), T_world_object, BOUNDS)
    size = np.linalg.norm(triangles / [0.05, 0.03, 0.02], axis=-1)
    np.testing.assert_allclose(size, 1, atol=0.02)  # in the object's frame, within a fifth of a cell
    mesh = trimesh.Trimesh(triangles.reshape(-1, 3), np.arange(3 * len(triangles)).reshape(-1, 3))
    assert mesh.is_watertight and abs(mesh.volume) == pytest.approx(4 / 3 * np.pi * 3e-5, rel=0.03)
    away = surface_triangles(Ellipsoid(jnp.array([2.0, 0.0, 0.0])), T_world_object, BOUNDS)
    assert away.shape == (0, 3, 3)


@pytest.fixture
def panels():
    block = np.asarray(trimesh.creation.box((0.10, 0.06, 0.04)).triangles)
    T = np.eye(4)
    T[:3, 3] = 0.05, 0, 0
    far = T.copy()
    far[:3, 3] = 5.0
    first = Panel("one", "IoU 0.80", "0.5 cm, 3° off", block, block * 0.9, T, T, 0.06)
    return [first] * 5 + [dataclasses.replace(first, name="six", reconstructed=block[:0], T_object_estimate=far)]


def panels_of(figure):
    return [axes for axes in figure.axes if axes.name == "3d"]


def check_layout(figure):
    """Equal scale everywhere; panels and words inside of the figure and apart from each other."""
    figure.canvas.draw()
    axes = panels_of(figure)
    spans = [[np.ptp(getattr(one, f"get_{name}lim")()) for name in "xyz"] for one in axes]
    np.testing.assert_allclose(spans, spans[0][0], rtol=1e-6)
    boxes = [one.get_position().transformed(figure.transFigure) for one in axes]
    boxes += [text.get_window_extent() for text in figure.texts] + [
        legend.get_window_extent() for legend in figure.legends
    ]
    for index, box in enumerate(boxes):
        assert (
            figure.bbox.x0 <= box.x0
            and box.x1 <= figure.bbox.x1
            and figure.bbox.y0 <= box.y0
            and box.y1 <= figure.bbox.y1
        )
        for other in boxes[:index]:
            overlap = min(box.x1, other.x1) - max(box.x0, other.x0), min(box.y1, other.y1) - max(box.y0, other.y0)
            assert min(overlap) < 1


def test_reconstructions_stand_below_the_true_surfaces(panels, coarse):
    figure = reconstruction_figure(panels, "title")
    axes = panels_of(figure)
    assert len(axes) == 12 and figure.get_suptitle() == "title"
    words = [text.get_text() for text in figure.texts]
    assert words.count("one\nIoU 0.80") == 5 and words.count("six\nIoU 0.80") == 1 and words.count("5 cm") == 1
    assert words.count("true") == words.count("reconstructed") == 2  # of each block of rows
    assert [len(one.collections) for one in axes] == [1] * 11 + [0]
    assert axes[-1].texts[0].get_text() == "empty"
    tops = [one.get_position().y0 for one in axes]
    assert tops[1] < tops[0] and tops[10] < tops[1]
    check_layout(figure)


def test_boxes_are_drawn_at_the_true_and_the_found_place(panels, coarse, monkeypatch):
    drawn = []
    box = reconstruction.polygons3d.box

    def watching(corners, colour, **how):
        drawn.append((corners, how))
        return box(corners, colour, **how)

    monkeypatch.setattr(reconstruction.polygons3d, "box", watching)
    figure = transfer_figure(panels)
    assert len(panels_of(figure)) == 6 and len(drawn) == 12
    np.testing.assert_allclose([drawn[0][0].min(axis=0), drawn[0][0].max(axis=0)], [[2, -3, -3], [8, 3, 3]])
    assert drawn[0][1] == {"filled": False, "dashed": True} and drawn[1][1] == {}
    np.testing.assert_allclose(drawn[11][0].mean(axis=0), 500)
    span = np.ptp(panels_of(figure)[0].get_xlim())
    assert 10 < span < 45  # a box 8 m away does not make the others small
    check_layout(figure)


def test_the_scale_bar_is_as_long_as_it_says(panels, coarse):
    from mpl_toolkits.mplot3d import proj3d

    figure = transfer_figure(panels)
    figure.canvas.draw()
    axes = panels_of(figure)[0]
    around = np.radians(axes.azim)
    across = 5 * np.array([-np.sin(around), np.cos(around), 0])
    ends = [
        axes.transData.transform(proj3d.proj_transform(*point, axes.get_proj())[:2]) for point in (0 * across, across)
    ]
    (bar,) = [artist for artist in figure.artists + figure.lines if hasattr(artist, "get_xdata")]
    assert np.ptp(bar.get_xdata()) * figure.bbox.width == pytest.approx(np.linalg.norm(ends[1] - ends[0]), rel=1e-3)
