"""An arm of seven joints from a file: a hand whose fingers a tendon drives, with ribs, in joints with friction."""

import numpy as np
import pytest
from conftest import angle, lifted

import tdf_jax as tdf
from tdf_jax._internal.errors import InputError
from tdf_jax.sim.episode import run_episode
from tdf_jax.sim.execution import Controller, execute
from tdf_jax.sim.kinematics import kinematics_of
from tdf_jax.sim.tasks import draw_episode
from tdf_jax.sim.workcell import build_workcell

mujoco = pytest.importorskip("mujoco", reason="the extra 'sim' is not installed")

# Lengths as of common arms of seven joints. The site is not in the file unless it is put there.
ARM = """<mujoco model="seven">
  <compiler angle="radian" autolimits="true"/>
  <default>
    <joint axis="0 0 1" armature=".1" damping="4" frictionloss="1" range="-2.9 2.9"/>
    <geom type="capsule" size=".045" density="400"/>
    <default class="finger">
      <joint type="slide" axis="0 1 0" range="0 .04" frictionloss="0" damping="1"/>
      <geom type="box" density="200"/>
    </default>
  </default>
  <worldbody>
    <body name="base"><geom fromto="0 0 .05 0 0 .19"/>
    <body name="l1" pos="0 0 .333"><joint name="j1"/><geom type="sphere" size=".05"/>
    <body name="l2" quat="1 -1 0 0"><joint name="j2" range="-1.76 1.76"/><geom fromto="0 -.02 0 0 -.22 0"/>
    <body name="l3" pos="0 -.316 0" quat="1 1 0 0"><joint name="j3"/><geom type="sphere" size=".05"/>
    <body name="l4" pos=".0825 0 0" quat="1 1 0 0"><joint name="j4" range="-3.07 -.07"/>
      <geom fromto="-.0825 .06 0 -.0825 .3 0"/>
    <body name="l5" pos="-.0825 .384 0" quat="1 -1 0 0"><joint name="j5"/><geom type="sphere" size=".03"/>
    <body name="l6" quat="1 1 0 0"><joint name="j6" range="-.01 3.75"/><geom type="sphere" size=".03"/>
    <body name="l7" pos=".088 0 0" quat="1 1 0 0"><joint name="j7"/><geom fromto="0 0 .05 0 0 .07" size=".03"/>
    <body name="hand" pos="0 0 .107" quat="0.9238795 0 0 -0.3826834">
      <geom type="box" size=".02 .1 .033" pos="0 0 .033"/>{site}
      <body name="left" pos="0 0 .06" childclass="finger"><joint name="left"/>
        <geom size=".01 .004 .022" pos="0 .0065 .022"/><geom size=".003 .002 .006" pos=".006 .002 .038"/>
        <geom size=".003 .002 .006" pos="-.006 .002 .038"/><geom size=".003 .002 .004" pos=".006 .002 .024"/></body>
      <body name="right" pos="0 0 .06" quat="0 0 0 1" childclass="finger"><joint name="right"/>
        <geom size=".01 .004 .022" pos="0 .0065 .022"/><geom size=".003 .002 .006" pos=".006 .002 .038"/>
        <geom size=".003 .002 .006" pos="-.006 .002 .038"/><geom size=".003 .002 .004" pos="-.006 .002 .024"/></body>
    </body></body></body></body></body></body></body></body></body>
  </worldbody>
  <tendon><fixed name="both"><joint joint="left" coef=".5"/><joint joint="right" coef=".5"/></fixed></tendon>
  <equality><joint joint1="left" joint2="right" solref=".005 1"/></equality>
  <actuator>
    <position name="a1" joint="j1" kp="4500" kv="450" forcerange="-87 87"/>
    <position name="a2" joint="j2" kp="4500" kv="450" forcerange="-87 87"/>
    <position name="a3" joint="j3" kp="3500" kv="350" forcerange="-87 87"/>
    <position name="a4" joint="j4" kp="3500" kv="350" forcerange="-87 87"/>
    <position name="a5" joint="j5" kp="2000" kv="200" forcerange="-20 20"/>
    <position name="a6" joint="j6" kp="2000" kv="200" forcerange="-20 20"/>
    <position name="a7" joint="j7" kp="2000" kv="200" forcerange="-20 20"/>
    <position name="grasp" tendon="both" kp="{kp}" kv="200" ctrlrange="0 .04" forcerange="-60 60"/>
  </actuator>
  <keyframe><key name="home" qpos="0 0 0 -1.57 0 1.57 -.785 .04 .04"/></keyframe>
</mujoco>"""
SITE = '<site name="grip" pos="0 0 .098"/>'


@pytest.fixture(scope="module")
def write(tmp_path_factory):
    def write(site=SITE, kp=10000):
        path = tmp_path_factory.mktemp("arm") / "seven.xml"
        path.write_text(ARM.format(site=site, kp=kp))
        return path

    return write


@pytest.fixture(scope="module")
def seven(robot, write):
    return tdf.load_robot(write(), "grip")


def test_ribs_are_what_the_fingers_hold_with(seven):
    fingers = seven.fingers
    assert seven.num_joints == 7 and fingers.widest == pytest.approx(0.08, abs=5e-4)
    # Between the ribs rays meet what is 2 mm behind them, on one side or on both.
    np.testing.assert_allclose(np.diff(fingers.openings[:-1]), np.diff(fingers.commands[:-1]) * 2, atol=1e-4)
    # Ribs from 20 to 28 and from 32 to 44 mm of the fingers, with a gap of 4 mm: one pad, the tip 6 mm from the site.
    np.testing.assert_allclose(fingers.tips[:-1], 0.006, atol=0.0015)
    np.testing.assert_allclose(fingers.depths[:-1], -0.006, atol=0.0015)


def test_the_force_of_the_fingers_is_that_of_the_physics(seven):
    """A tendon that halves: each finger gets half of the actuator's 60 N, or of its stiffness times the opening."""
    narrow = seven.fingers.openings[-2]
    for opening, force in ((0.04, 30.0), (0.02, 30.0), (narrow, 0.5 * 10000 * narrow / 2)):
        assert seven.fingers.force(opening) == pytest.approx(force, rel=0.1)


def test_weak_fingers_are_warned_of(robot, write):
    weak = tdf.load_robot(write(kp=100), "grip")
    with pytest.warns(UserWarning, match="fingers of seven press with 0.1 N on something 5 mm wide.*'grasp'"):
        fingers = weak.fingers
    assert fingers.force(0.005) == pytest.approx(0.5 * 100 * 0.0025, rel=0.2)


def test_a_missing_site_is_shown_with_the_line_to_add(robot, write):
    """The line in the message makes a robot of the file."""
    with pytest.raises(
        InputError, match="has no site 'grip'; it has none. Name .* or add .* in the body 'hand'"
    ) as raised:
        tdf.load_robot(write(site=""), "grip")
    line = str(raised.value).split("or add ")[1].split(" in the body")[0]
    hinted = tdf.load_robot(write(site=line), "grip")
    T, expected = (kinematics_of(one).pose(one.home) for one in (hinted, tdf.load_robot(write(), "grip")))
    assert np.linalg.norm(T[:3, 3] - expected[:3, 3]) < 0.01 and angle(T, expected) < 1e-3


@pytest.fixture(scope="module")
def motion(seven):
    start = kinematics_of(seven).pose(seven.home)
    ends = start.copy(), start.copy()
    ends[0][:3, 3], ends[1][:3, 3] = (0.5, 0.2, 0.15), (0.5, -0.2, 0.2)
    return tdf.plan_joints(tdf.Trajectory.from_matrices(lifted(*ends)), seven)


def test_friction_and_damping_of_the_joints_do_not_leave_the_arm_behind(seven, motion):
    kinematics, cell = kinematics_of(seven), build_workcell(seven)
    data, errors = cell.data(), []

    def watch(data, step, phase):
        if step % 20 == 0:
            joints, _ = motion.at(min(data.time, motion.duration))
            expected, found = kinematics.pose(joints), kinematics.pose(data.qpos[cell.arm])
            errors.append((np.linalg.norm(expected[:3, 3] - found[:3, 3]), angle(expected, found)))

    execute(cell, data, motion, watch)
    distances, angles = np.array(errors).T
    assert distances.max() < 1e-3 and angles.max() < 0.5
    assert Controller(cell, motion).friction == pytest.approx(1.0)


@pytest.mark.slow
@pytest.mark.parametrize("task", ["bowl_on_shelf", "bottle_on_shelf"])
def test_an_episode_of_the_truth_succeeds(seven, task):
    episode = draw_episode(task, seven, 831, 0)
    outcome = run_episode(episode, seven, [lifted(episode.pick, episode.release, 0.2)])
    assert outcome.strict, outcome
