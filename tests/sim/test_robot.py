"""Robots: the calibration of a gripper, files of other robots, and what is refused."""

from typing import Any

import numpy as np
import pytest
from conftest import ARM_FINGER, ARM_PARTS

import tdf_jax as tdf
from tdf_jax._internal.errors import InputError
from tdf_jax.sim.workcell import build_workcell

mujoco = pytest.importorskip("mujoco", reason="the extra 'sim' is not installed")


def test_the_gripper_of_the_ur5e_is_measured(robot):
    fingers = robot.fingers
    assert fingers.widest == pytest.approx(0.085, abs=0.001)  # the 85 in its name, millimetres
    assert (np.diff(fingers.openings) < 0).all() and fingers.openings[-1] == 0
    # The pads move forward along the approach as they close, by 1.3 cm from the widest opening. Rays find their middle
    # and their tips where the boxes of the model are.
    cell = build_workcell(robot, floating=True)
    data = cell.data()
    pads = [number for number in range(cell.model.ngeom) if "pad" in cell.model.geom(number).name]
    assert len(pads) == 4
    for opening, depth, tip in zip(fingers.openings, fingers.depths, fingers.tips):
        cell.open_fingers(data, opening)
        mujoco.mj_forward(cell.model, data)
        frame = cell.gripper_pose(data)
        heights = (data.geom_xpos[pads] - frame[:3, 3]) @ frame[:3, 2]
        assert depth == pytest.approx(heights.mean(), abs=0.001)
        assert tip == pytest.approx(heights.max() + cell.model.geom_size[pads[0], 2], abs=0.0015)
    for opening in (0.0, 0.02, 0.05, fingers.widest):
        command = fingers.command(opening)
        assert np.interp(command, fingers.commands, fingers.openings) == pytest.approx(opening, abs=1e-9)
    assert fingers.command(0.2) == fingers.command(fingers.widest)


def test_the_ur5e_is_an_arm_of_six_joints_with_a_home_that_points_down(robot):
    assert robot.num_joints == 6 and all("shoulder" in name for name in robot.joints[:2])
    assert (robot.lower < robot.home).all() and (robot.home < robot.upper).all()
    cell = build_workcell(robot)
    T = cell.gripper_pose(cell.data())
    np.testing.assert_allclose(T[:3, 2], (0, 0, -1), atol=1e-3)
    assert T[2, 3] > 0.3


def test_a_robot_from_a_file_and_its_fingers(arm):
    robot = tdf.load_robot(arm(), "grip", max_velocity=0.7)
    assert robot.joints == ("a", "b", "c") and robot.actuators == ("A", "B", "C")
    assert robot.finger_actuator == "squeeze" and robot.name == "arm"
    np.testing.assert_array_equal(robot.home, (0.3, 0.2, 0.1))
    np.testing.assert_allclose(robot.lower, (-2, -2, -2 * np.pi))
    np.testing.assert_array_equal(robot.max_velocity, (0.7, 0.7, 0.7))
    fingers = robot.fingers
    # Each finger is where it is commanded to be, at rest.
    np.testing.assert_allclose(fingers.openings, 2 * fingers.commands, atol=1e-4)
    assert fingers.widest == pytest.approx(0.08, abs=1e-4)
    # The pads are 6 cm long, and their middle is 2 cm behind the site.
    np.testing.assert_allclose(fingers.depths, -0.02, atol=0.002)


def test_the_home_is_the_given_one_or_zero_without_a_keyframe(arm):
    assert (tdf.load_robot(arm(key=""), "grip").home == 0).all()
    np.testing.assert_array_equal(tdf.load_robot(arm(), "grip", home=(0.5, 0, 0)).home, (0.5, 0, 0))


def test_a_hand_alone_has_neither_the_arm_nor_its_actuators(robot):
    model = robot.hand_spec().compile()
    names = [model.joint(number).name for number in range(model.njnt)]
    assert not {f"robot/{name}" for name in robot.joints} & set(names)
    assert sorted(names) == sorted(f"robot/{name}" for name in robot.fingers.joints)
    assert [model.actuator(number).name for number in range(model.nu)] == [f"robot/{robot.finger_actuator}"]
    assert model.site(f"robot/{robot.site}").id >= 0
    assert 0.5 < model.body_mass.sum() < 3  # of a gripper and a wrist, not of an arm


@pytest.mark.parametrize(
    ("parts", "message"),
    [
        ({"first": ""}, "the joints a of .* have no actuator; expected a position actuator"),
        ({"first": '<motor name="A" joint="a"/>'}, "the actuators A of .* do not hold a position"),
        ({"fingers": ""}, "0 actuators besides the arm's; expected one, of the fingers"),
        ({"fingers": ARM_PARTS["fingers"] + '<motor name="z" joint="right"/>'}, "has 2 actuators besides the arm's"),
        ({"free": 'type="slide"'}, "the site 'grip' of .* is not carried by an arm of hinge joints alone"),
        ({"first": "<position"}, "cannot be read"),
        ({"first": '<position name="A" joint="nothing"/>'}, "nothing"),
    ],
    ids=lambda value: value[:30] if isinstance(value, str) else "",
)
def test_a_file_that_is_no_arm_with_a_gripper_is_refused(arm, parts, message):
    with pytest.raises(InputError, match=rf"load_robot\(\): .*{message}"):
        tdf.load_robot(arm(**parts), "grip")


def test_fingers_that_do_not_close_are_refused(arm):
    """Both on one side of the site."""
    robot = tdf.load_robot(arm(right=ARM_FINGER.format(name="right", side=1, offset=0.03)), "grip")
    with pytest.raises(InputError, match="expected two fingers on both sides along the site's y axis"):
        robot.fingers  # noqa: B018


def test_wrong_arguments_are_refused(arm, tmp_path):
    calls: tuple[tuple[str, tuple[Any, ...], dict[str, Any]], ...] = (
        ("there is no file .*missing.xml; expected an MJCF", (tmp_path / "missing.xml", "grip"), {}),
        ("has no site 'pinch'; it has still, grip", (arm(), "pinch"), {}),
        ("the site 'still' of .* is not carried by an arm", (arm(), "still"), {}),
        ("is given without a site; name the site", (arm(),), {}),
        ("there is a site and no file", (None, "grip"), {}),
        ("expected a path", (3, "grip"), {}),
        (r"home is \(0, 0\); expected 3 finite angles", (arm(), "grip"), {"home": (0, 0)}),
        ("home is .*; expected 3 finite angles", (arm(), "grip"), {"home": (0, 0, np.nan)}),
        ("home is .*3.* outside of .* limits", (arm(), "grip"), {"home": (0, 3, 0)}),
        ("max_velocity is 0", (arm(), "grip"), {"max_velocity": 0}),
        ("max_velocity is 60; expected rad.s, at most 20", (arm(), "grip"), {"max_velocity": 60}),
        ("max_acceleration is -1", (arm(), "grip"), {"max_acceleration": -1}),
    )
    for message, arguments, options in calls:
        with pytest.raises(InputError, match=rf"load_robot\(\): .*{message}"):
            tdf.load_robot(*arguments, **options)


def test_a_missing_engine_is_named(monkeypatch):
    import sys

    monkeypatch.setitem(sys.modules, "mujoco", None)
    with pytest.raises(InputError, match=r"load_robot\(\): mujoco is not installed .*pip install 'tdf_jax\[sim\]'"):
        tdf.load_robot()
