"""What bodies look like: fewer triangles, and the surfaces of a robot."""

import numpy as np
import pytest
import trimesh

from tdf_jax.sim.solids import MOST_OF_GEOM, robot_solids, simplified

mujoco = pytest.importorskip("mujoco", reason="the extra 'sim' is not installed")

ARM = """<mujoco>
  <asset><mesh name="wedge" vertex="0 0 0  .1 0 0  0 .2 0  0 0 .3"/><material name="red" rgba="1 0 0 1"/></asset>
  <worldbody>
    <geom type="plane" size="1 1 1"/>
    <body name="robot/link" pos="0 0 1">
      <geom type="box" size=".05 .06 .07" pos=".1 0 0" quat=".7071068 0 0 .7071068" contype="0" conaffinity="0"
        material="red"/>
      <geom type="sphere" size=".4"/>
    </body>
    <body name="robot/tip">
      <geom type="capsule" size=".02 .1"/><geom type="cylinder" size=".03 .05"/><geom type="sphere" size=".04"/>
      <geom type="mesh" mesh="wedge" rgba="0 1 0 1"/>
    </body>
    <body name="object"><geom type="sphere" size=".1"/></body>
  </worldbody>
</mujoco>"""


def test_a_surface_of_fewer_triangles_is_near_the_surface():
    ball = trimesh.creation.icosphere(5, 0.1)
    vertices, faces = simplified(ball.vertices, ball.faces, 1500)
    assert 700 < len(faces) <= 1500 and faces.max() == len(vertices) - 1
    np.testing.assert_allclose(np.linalg.norm(vertices, axis=1), 0.1, atol=0.003)
    fewer = trimesh.Trimesh(vertices, faces, process=False)
    assert fewer.area == pytest.approx(ball.area, rel=0.03)
    same = simplified(ball.vertices, ball.faces, len(ball.faces))
    np.testing.assert_array_equal(same[0][same[1]], ball.triangles)


def test_a_robot_shows_its_surfaces_for_pictures_or_else_those_for_contacts():
    solids = robot_solids(mujoco.MjModel.from_xml_string(ARM))
    assert [one.body for one in solids] == ["robot/link", *["robot/tip"] * 4]
    box, capsule, cylinder, sphere, wedge = solids
    assert box.colour == (1, 0, 0) and wedge.colour == (0, 1, 0) and box.angular and not sphere.angular
    np.testing.assert_allclose(np.ptp(box.vertices, axis=0), [0.12, 0.1, 0.14], atol=1e-6)  # turned about z
    np.testing.assert_allclose(box.vertices.mean(axis=0), [0.1, 0, 0], atol=1e-9)
    for one, size in ((capsule, (0.04, 0.04, 0.24)), (cylinder, (0.06, 0.06, 0.1)), (sphere, (0.08,) * 3)):
        np.testing.assert_allclose(np.ptp(one.vertices, axis=0), size, atol=1e-3)
        np.testing.assert_allclose(one.vertices.min(axis=0) + one.vertices.max(axis=0), 0, atol=1e-6)
    corners = np.array([(0, 0, 0), (0.1, 0, 0), (0, 0.2, 0), (0, 0, 0.3)])
    for corner in corners:  # the engine moves a mesh to its centre of mass and axes, and the geom back
        assert np.linalg.norm(wedge.vertices - corner, axis=1).min() < 1e-6


def test_the_arm_and_the_gripper_have_few_triangles(robot):
    from tdf_jax.sim.workcell import build_workcell

    solids = robot_solids(build_workcell(robot).model)
    assert len({one.body for one in solids}) > 10 and max(len(one.faces) for one in solids) <= MOST_OF_GEOM
    assert sum(len(one.faces) for one in solids) > 5000
