"""Placed objects, cut open: what is drawn is behind the contact, where the object was put and where it belongs."""

import numpy as np
import pytest

from tdf_jax.evaluation.relation_report import failures, page, picture
from tdf_jax.evaluation.relation_scores import LIBRARY, UNSEATED, Condition, Score
from tdf_jax.evaluation.relation_success import Placed
from tdf_jax.geometry.symmetry import about_z
from tdf_jax.shapes import build_bottle, build_container
from tdf_jax.viz.placements import OBJECT_COLOUR, PlacedMeshes, placements_figure

DROPPED = 0.03


@pytest.fixture(scope="module")
def figure():
    """A bottle in a container that is turned about the vertical, 3 cm too deep."""
    bottle, container, turned = build_bottle(), build_container(), about_z(1.0)
    contact = container.frames["floor"]
    true = contact.copy()
    true[2, 3] -= bottle.mesh.bounds[0, 2]
    found = true.copy()
    found[2, 3] -= DROPPED
    poses = (turned @ found, turned @ true, turned @ contact)
    return placements_figure(
        [PlacedMeshes("too deep", bottle.mesh, container.mesh.copy().apply_transform(turned), *poses)]
    )


def drawn(axes):
    """Corners of what is drawn of the object and of the target, metres, relative to the panel's middle."""
    (collection,) = axes.collections
    polygons = np.array([np.asarray(one)[:, :3] for one in collection._faces]).reshape(-1, 3, 3)
    colours = np.array(collection._facecolor3d)[:, :3]
    green = np.isclose(colours / colours.max(axis=1, keepdims=True), OBJECT_COLOUR / OBJECT_COLOUR.max(), atol=0.02)
    is_object = green.all(axis=1)
    return polygons[is_object], polygons[~is_object]


def test_a_placement_is_drawn_above_the_right_one(figure):
    above, below = figure.axes
    assert above.get_title() == "too deep"
    (low, target), (high, same) = drawn(above), drawn(below)
    np.testing.assert_allclose(high[..., 2].min() - low[..., 2].min(), DROPPED, atol=1e-5)
    np.testing.assert_allclose(target, same)


def test_the_half_in_front_is_cut_away_and_the_picture_turns_with_the_contact(figure):
    for axes in figure.axes:
        placed, target = drawn(axes)
        assert np.isclose(target[..., 1].min(), placed[..., 1].min(), atol=1e-6)  # one plane for both
        assert np.ptp(placed[..., 1]) < 0.55 * np.ptp(placed[..., 0])  # half of a round bottle
        # a wall along the picture's x axis: the container stands as in its own frame
        np.testing.assert_allclose(np.ptp(target[..., 0]), build_container().mesh.extents[0], atol=1e-4)


def test_the_page_shows_the_first_failures_of_the_library():
    condition = Condition("bottle_in_container", "upright", "full", 1)
    right, wrong = Placed(0.0, 0.0, 1.0, True, True), Placed(0.0, 0.01, 1.0, True, True)
    scores = [Score(UNSEATED, condition, 0, 0, wrong, 1.0, np.eye(4))]
    scores += [
        Score(LIBRARY, condition, number, 0, right if number == 1 else wrong, 1.0, np.eye(4)) for number in range(8)
    ]
    assert [one.number for one in failures(scores, condition.task)] == [0, 2, 3, 4, 5]
    settings, redrawn = {"seed": 0, "pairs": 8}, {condition.task: 0}
    assert f"]({picture(condition.task)})" in page(scores, settings, redrawn)
    assert picture(condition.task) not in page([scores[2]], settings, redrawn)
