"""The study of approaches: an object that the open hand passes, one that it hits, and one that it cannot grasp."""

import numpy as np
import pytest

from tdf_jax._internal.errors import InputError
from tdf_jax.shapes import FAMILIES
from tdf_jax.sim import approach_study
from tdf_jax.sim.approach_study import approach_depth, main
from tdf_jax.sim.collision import TOUCHING


def bowl(number=0):
    return FAMILIES["bowl"].build(FAMILIES["bowl"].sample(np.random.default_rng([70, number])))


def test_the_open_hand_passes_a_wall_and_fingers_that_hardly_open_hit_it(robot, monkeypatch):
    assert approach_depth(bowl(), robot) <= TOUCHING
    grip_of = approach_study.grip_of
    monkeypatch.setattr(approach_study, "grip_of", lambda *words: grip_of(*words)._replace(opening=0.0))
    assert approach_depth(bowl(), robot) > TOUCHING


@pytest.mark.parametrize(("down", "passes"), [(0.0, True), (0.2, False)])
def test_the_hand_does_not_pass_through_the_table(robot, monkeypatch, down, passes):
    """Beside the object, where it meets nothing else."""
    grip_of = approach_study.grip_of

    def aside(*words):
        grip = grip_of(*words)
        T = grip.T_object_grip.copy()
        T[:3, 3] += (0.4, 0, -down)
        return grip._replace(T_object_grip=T)

    monkeypatch.setattr(approach_study, "grip_of", aside)
    assert (approach_depth(bowl(), robot) <= TOUCHING) is passes


def test_an_object_without_a_grasp_counts_as_one_that_is_not_approached(robot, monkeypatch, capsys):
    def refuse(shape, robot):
        raise InputError("wider than the gripper")

    monkeypatch.setattr(approach_study, "approach_depth", refuse)
    main(["--objects", "2"])
    found = capsys.readouterr()
    assert "| mug | 2 | 0 %" in found.out and "bottle 1: wider than the gripper" in found.err


@pytest.mark.slow
def test_the_table_has_the_share_of_each_category(capsys):
    main(["--objects", "1", "--seed", "70"])
    lines = capsys.readouterr().out.splitlines()
    assert [line.split(" | ")[0].strip("| ") for line in lines[2:]] == list(approach_study.CATEGORIES)
    assert all(line.split(" | ")[2].startswith("100 %") for line in lines[2:])
