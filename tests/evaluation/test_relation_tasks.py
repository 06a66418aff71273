"""Tasks of an object and a target, and the judge: true placements hold, and each way to be wrong fails."""

import dataclasses

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from tdf_jax._internal.errors import InputError
from tdf_jax.evaluation import relation_study
from tdf_jax.evaluation.relation_success import judge
from tdf_jax.evaluation.relation_tasks import RELATIONS, demonstrate, draw_pair, place_pair
from tdf_jax.geometry.trajectory import Trajectory
from tdf_jax.networks.checkpoint import load_model

SLOW = pytest.mark.slow
TASKS = ["bottle_in_container", *(pytest.param(task, marks=SLOW) for task in ("mug_on_rack", "bowl_on_mug"))]


@pytest.fixture(scope="module", params=TASKS)
def pair(request):
    return draw_pair(request.param, 0, 0)


def shifted(T, offset, degrees=(0, 0, 0)):
    """A pose moved by an offset, and turned about the object's origin, axes of the target."""
    moved = T.copy()
    moved[:3, 3] += offset
    moved[:3, :3] = Rotation.from_euler("xyz", degrees, degrees=True).as_matrix() @ T[:3, :3]
    return moved


def test_the_true_placement_holds_and_one_with_a_gap_or_overlap_does_not(pair):
    truth = judge(pair, pair.T_target_object)
    assert truth.holds(0.001) and truth.gap < 0.001 and truth.penetration == 0
    up = np.array([0, 0, 0.004])
    above, below = judge(pair, shifted(pair.T_target_object, up)), judge(pair, shifted(pair.T_target_object, -up))
    if pair.task != "mug_on_rack":  # a mug that is lifted may touch the peg with the other side of the hole
        assert 0.003 < above.gap < 0.005 and not above.holds() and above.holds(0.005)
    assert below.penetration > 0.002 and not below.holds()


def test_a_tilted_object_or_one_beside_its_target_does_not_hold(pair):
    far = judge(pair, shifted(pair.T_target_object, [0.0, 0.5, 0.0]))
    assert far.gap > 0.05 and not far.supported and not far.holds()
    if pair.task == "mug_on_rack":
        off = pair.T_target_contact[:3, 0] * (pair.target.parameters.peg_length + 0.05)
        assert not judge(pair, shifted(pair.T_target_object, off)).hung
    else:
        tilted = judge(pair, shifted(pair.T_target_object, [0, 0, 0.2], (20, 0, 0)))
        assert abs(tilted.tilt - 20) < 1e-6 and not dataclasses.replace(tilted, gap=0.0, supported=True).holds()


def test_a_mug_hangs_by_its_handle_alone():
    """Over the peg's tip, the peg inside the cavity: it touches, and no peg crosses the finger hole."""
    pair = draw_pair("mug_on_rack", 0, 0)
    assert pair.target.category == "rack" and judge(pair, pair.T_target_object).hung
    over = pair.T_target_object.copy()
    root, tip = pair.target.peg_lines[0]
    over[:3, :3] = np.diag([1.0, -1.0, -1.0])  # upside down
    over[:3, 3] = tip + [0, 0, pair.object.height / 2]
    assert not judge(pair, over).hung


def test_support_is_lost_where_the_centre_of_mass_leaves_the_floor():
    pair = draw_pair("bottle_in_container", 0, 0)
    half = pair.object.mesh.extents[:2].max() / 2
    outside = shifted(pair.T_target_object, [pair.target.mesh.extents[0] / 2 + 0.2 * half, 0, 0.0])
    assert not judge(pair, outside).supported


def test_a_demonstration_ends_at_the_true_placement(pair):
    demonstration = demonstrate(pair, 3, points=200)
    motion = np.asarray(Trajectory(np.asarray(demonstration.object_motion)[None]).matrices[0], float)
    released = np.asarray(demonstration.points, float) @ motion[:3, :3].T + motion[:3, 3]
    T_world_target = np.eye(4)
    T_world_target[2, 3] = -pair.target.mesh.bounds[0, 2]
    expected = pair.object.mesh.bounds @ np.eye(3)
    corners = (released - T_world_target[:3, 3] - pair.T_target_object[:3, 3]) @ pair.T_target_object[:3, :3]
    assert (corners > expected[0] - 1e-5).all() and (corners < expected[1] + 1e-5).all()
    assert demonstration.points.shape == (200, 3) and abs(demonstration.points[:, 2].min()) < 0.02  # on the table


@pytest.mark.parametrize("poses, most", [("upright", 0.0), ("tilt60", 75.6), ("uniform", 180.0)])
def test_poses_of_the_world(poses, most):
    pair = draw_pair("bottle_in_container", 0, 1)
    tilts = []
    for seed in range(12):
        placement = place_pair(pair, seed, poses, points=20)
        np.testing.assert_allclose(placement.placed(placement.motion), pair.T_target_object, atol=1e-12)
        for T in (placement.T_world_object, placement.T_world_target):
            tilts.append(np.degrees(np.arccos(np.clip(T[2, 2], -1, 1))))
        assert np.linalg.norm(placement.points.mean(axis=0) - placement.T_world_object[:3, 3]) < 0.2
    assert max(tilts) <= most + 1e-4  # two tilts of 60 degrees make 75.5
    assert poses == "upright" or max(tilts) > 0.6 * most


def test_pairs_are_drawn_by_seed_and_number():
    first, again, other = (draw_pair("bottle_in_container", seed, 2) for seed in (4, 4, 5))
    assert first.object.parameters == again.object.parameters != other.object.parameters
    assert set(RELATIONS) == {"bowl_on_mug", "mug_on_rack", "bottle_in_container"}
    with pytest.raises(InputError, match="task is 'cup_on_plate'"):
        draw_pair("cup_on_plate", 0, 0)
    for word in ("poses", "clouds"):
        with pytest.raises(InputError, match=f"{word} is 'half'"):
            place_pair(first, 0, **{word: "half"})


@pytest.mark.slow
def test_parts_of_the_method_are_measured_at_the_truth(capsys):
    relation_study.main(["paths", "--pairs", "1"])
    lines = capsys.readouterr().out.splitlines()
    assert len(lines) == 3 * 3 * 6
    blended = (", even:", ", weights by nearness:")  # near the goal too
    assert all("off by 0 degrees" in line for line in lines if not any(name in line for name in blended))
    found = relation_study.touches("bowl_on_mug", load_model("bowl"), load_model("mug"), "full", 2)
    assert found.shape == (2,) and np.abs(found).max() < 0.003
    with pytest.raises(SystemExit):
        relation_study.main(["paths", "--pairs", "0"])
    assert "--pairs: 0 is given; expected at least 1" in capsys.readouterr().err
