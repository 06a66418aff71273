"""Every public function under the settings of JAX that users have, in their transformations, and with their arrays.

A setting must not change a result, nor must it end in an error. What cannot be traced is refused by its name.
"""

import contextlib
import dataclasses
import os
import subprocess
import sys
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import trimesh
from conftest import CARRY, random_cloud

import tdf_jax as tdf
from tdf_jax._internal.boundary import own_settings

FIXTURES = Path(__file__).parent / "fixtures"
KEY = jax.random.key(4)
SOLVE = tdf.SolveConfig(num_starts=4, num_trajectory_starts=2, num_coarse_queries=3, polish_steps=2)
ADAM = tdf.OptimizeConfig(num_starts=2, iterations=2)
SHAPE = {"num_poses": 4, "start": (0.1, 0.2, 0.3), "end": (0.4, 0.2, 0.1)}

SETTINGS = {
    "rank promotion": lambda: jax.numpy_rank_promotion("raise"),
    "dtype promotion": lambda: jax.numpy_dtype_promotion("strict"),
    "transfer guard": lambda: jax.transfer_guard("disallow"),
    "explicit transfer guard": lambda: jax.transfer_guard("disallow_explicit"),
    "infinities": lambda: jax.debug_infs(True),
    "x64": lambda: jax.enable_x64(True),
    "leaks": jax.checking_leaks,
    "NaN is no error": lambda: jax.debug_nans(False),  # it is one in all other tests
}


class World:
    """What the calls below take, made under no setting when it is first asked for."""

    MAKERS = {
        "vector": lambda w: jnp.array([0.01, 0.02, 0.03]),
        "zeros": lambda w: jnp.zeros(3),
        "axes": lambda w: jnp.eye(3),
        "steps": lambda w: jnp.arange(3.0),
        "path": lambda w: w.demonstration.trajectory,
        "poses": lambda w: w.path.wxyz_xyz,
        "query": lambda w: w.demonstration.query,
        "points": lambda w: np.asarray(w.demonstration.points),
        "shown": lambda w: jnp.asarray(w.demonstration.points),
        "cloud": lambda w: random_cloud(3).astype(np.float32),
        "pose": lambda w: w.path.wxyz_xyz[0],
        "goal": lambda w: w.path.wxyz_xyz[-1],
        "middle": lambda w: np.asarray(w.path.wxyz_xyz)[1, 4:],
        "grid": lambda w: tdf.plane_grid(0.02, 3),
        "landscape": lambda w: tdf.energy_landscape(w.field, w.reference, w.grid),
        "box": lambda w: tdf.box_obstacle((0.5, 0, 0), (0.1, 0.1, 0.1)),
        "near": lambda w: tdf.box_obstacle(w.middle, (0.02, 0.02, 0.02)),
        "distances": lambda w: tdf.cloud_obstacle(w.points, pitch=0.05),
        "mesh": lambda w: trimesh.creation.box((0.1, 0.1, 0.1)),
        "result": lambda w: tdf.carry(w.field, w.reference, KEY, goal=w.goal, config=CARRY),
        "picks": lambda w: np.asarray(w.result.trajectories)[:, 0],
        "residual": lambda w: jnp.float32(0.3),
        "openings": lambda w: jnp.array([0.02, 0.05, 0.08]),
        "limits": lambda w: jnp.array([1.0, 2.0, 3.0]),
        "short": lambda w: jnp.float32(0.06),
        "up": lambda w: jnp.array([-1.5, -2, 1.5, -1.5, -1.5, 0]),
        "arm": lambda w: tdf.load_robot(),
        "reached": lambda w: tdf.Trajectory(jnp.array([[0, 1, 0, 0, 0.5, y, 0.3] for y in (0.1, 0.0, -0.1)])),
        "rng": lambda w: np.random.default_rng(0),
        "seen": lambda w: np.full((24, 32), 0.5),
        "table": lambda w: np.stack([*np.meshgrid(*[np.linspace(0, 0.3, 40)] * 2), np.zeros((40, 40))], -1).reshape(
            -1, 3
        ),
        "block": lambda w: np.stack(np.meshgrid(*[np.linspace(0.1, 0.14, 9)] * 3), -1).reshape(-1, 3) - (0, 0, 0.099),
        "scene": lambda w: np.concatenate([w.table, w.block]),
        "placed": lambda w: w.points + np.asarray(w.path.wxyz_xyz)[-1, 4:] - np.asarray(w.path.wxyz_xyz)[0, 4:],
        "target": lambda w: tdf.Target(w.placed + np.float32(0.05), np.asarray(w.query) + w.placed.mean(axis=0)),
        "related": lambda w: dataclasses.replace(w.demonstration, target=w.target),
    }

    def __init__(self, **given):
        self.plain = {}
        vars(self).update(given)

    def __getattr__(self, name):
        with jax.enable_x64(False), own_settings():
            vars(self)[name] = self.MAKERS[name](self)
        return vars(self)[name]


@pytest.fixture(scope="module")
def world(small_model, demonstration, reference, field, tmp_path_factory):
    return World(
        model=small_model,
        demonstration=demonstration,
        reference=reference,
        field=field,
        folder=tmp_path_factory.mktemp("files"),
    )


def saved(w, name, save, load):
    path = w.folder / name
    save(path)
    return load(path)


# Every public function that computes or keeps arrays, and the classes that do, by a small call.
CALLS = {
    "DescriptorField": lambda w: (w.field.descriptors(w.query), w.field.occupancy(np.asarray(w.query)), w.field.latent),
    "Demonstration": lambda w: dataclasses.astuple(tdf.Demonstration(w.points, w.path, w.query).resampled(3)),
    "Grid": lambda w: tdf.Grid(w.zeros, w.axes, (w.steps, w.steps, w.steps)).points,
    "ImitationScene": lambda w: tdf.ImitationScene(w.demonstration, w.points, w.result).points,
    "JointTrajectory": lambda w: (lambda moved: (moved.positions, moved.velocities(), moved.at(w.steps)))(
        tdf.JointTrajectory(w.steps, w.axes, ("a", "b", "c"), w.openings)
    ),
    "Landscape": lambda w: (w.landscape.combined, w.landscape.minimisers, w.landscape.minimiser_rotations),
    "Result": lambda w: (
        w.result.trajectory,
        w.result.loss,
        w.result.best,
        w.result.pick,
        w.result.goal,
        w.result.picks,
        repr(w.result),
        w.result._repr_html_(),
    ),
    "Target": lambda w: dataclasses.astuple(tdf.Target(w.target.points, w.target.query)),
    "Trajectory": lambda w: (
        w.path.rotations,
        w.path.translations,
        tdf.Trajectory.from_matrices(w.path.matrices),
        w.path.transformed(w.pose),
        w.path.shifted((0, 0, 1)),
        w.path.displaced((0, 0, 1)),
    ),
    "box_obstacle": lambda w: (w.box, w.box.distance(w.query), tdf.box_obstacle((0, 0, 0), (1, 1, 1), (1, 0, 0, 0))),
    "box_query": lambda w: tdf.box_query(KEY, 4, centre=(0.1, 0.2, 0.3)),
    "build_bottle": lambda w: tdf.build_bottle().mesh.vertices,
    "build_bowl": lambda w: tdf.build_bowl().mesh.vertices,
    "build_container": lambda w: tdf.build_container().mesh.vertices,
    "build_mug": lambda w: tdf.build_mug().mesh.vertices,
    "build_rack": lambda w: tdf.build_rack().mesh.vertices,
    "carry": lambda w: tdf.carry(w.field, w.reference, KEY, goal=w.goal, config=CARRY),
    "carry_trajectory": lambda w: tdf.carry_trajectory(w.path, w.goal, w.pose),
    "clearance": lambda w: tdf.clearance(w.path, w.query, [w.box, w.near]).waypoints,
    "cloud_obstacle": lambda w: (tdf.cloud_obstacle(w.points, pitch=0.05), w.distances.distance(w.query)),
    "cluster_poses": lambda w: [mode.pose for mode in tdf.cluster_poses(w.picks, w.result.energies)],
    "compensator_loss": lambda w: tdf.compensator_loss(w.path),
    "confidence": lambda w: tdf.confidence(w.residual),
    "contact_query": lambda w: tdf.contact_query(w.points, w.points + np.float32(0.01), KEY, 4),
    "convert_checkpoint": lambda w: tdf.convert_checkpoint(FIXTURES / "ndf_latent32.pth"),
    "correlation_loss": lambda w: [
        tdf.correlation_loss(w.path, w.field.origin, w.reference, pose_norm=norm)
        for norm in ("frobenius", "metres_radians", "mean_absolute")
    ],
    "describe": lambda w: tdf.describe(w.model, [w.demonstration, w.demonstration], combine="median"),
    "descriptor_loss": lambda w: tdf.descriptor_loss(w.path, w.field, w.reference),
    "displace": lambda w: tdf.displace(w.path, (0, 0, 1)),
    "differentiable_pick": lambda w: (lambda found: (dataclasses.astuple(found), found.status))(
        tdf.differentiable_pick(w.field, w.reference, w.pose)
    ),
    "drop_invalid": lambda w: tdf.drop_invalid(w.shown),
    "encode": lambda w: tdf.encode(w.model, w.cloud),
    "energy_landscape": lambda w: tdf.energy_landscape(w.field, w.reference, w.grid).values,
    "field_obstacle": lambda w: tdf.field_obstacle(w.field, w.cloud, pitch=0.02),
    "gaussian_query": lambda w: tdf.gaussian_query(KEY, 4, centre=(0.1, 0.2, 0.3)),
    "gripper_query": lambda w: tdf.gripper_query(KEY, 4),
    "hang_on_rack": lambda w: tdf.hang_on_rack(**SHAPE, approach=(0, 0.1, 0)),
    "imitate": lambda w: tdf.imitate(w.model, w.demonstration, w.cloud, key=KEY, goal_offset=(0, 0, 0.1), config=CARRY),
    "imitate_batch": lambda w: tdf.imitate_batch(w.model, w.reference, [w.cloud], key=KEY, config=CARRY),
    "lattice_query": lambda w: tdf.lattice_query((2, 1, 2)),
    "lift_over": lambda w: tdf.lift_over(**SHAPE),
    "line": lambda w: tdf.line(**SHAPE, rotation=(1, 0, 0, 0)),
    "load_demonstration": lambda w: dataclasses.astuple(
        saved(w, "d.npz", lambda path: tdf.save_demonstration(path, w.demonstration), tdf.load_demonstration)
    ),
    "load_imitation": lambda w: (lambda scene: (scene.points, scene.result.trajectories, scene.demonstration.query))(
        saved(
            w,
            "i.npz",
            lambda path: tdf.save_imitation(path, tdf.ImitationScene(w.demonstration, w.points, w.result)),
            tdf.load_imitation,
        )
    ),
    "load_joint_trajectory": lambda w: (lambda read: (read.times, read.positions, read.gripper))(
        saved(
            w,
            "j.npz",
            lambda path: tdf.JointTrajectory(w.steps, w.axes, ("a", "b", "c"), w.openings).save(path),
            tdf.load_joint_trajectory,
        )
    ),
    "load_landscape": lambda w: (
        saved(w, "l.npz", lambda path: tdf.save_landscape(path, w.landscape), tdf.load_landscape)[0].values
    ),
    "load_mesh": lambda w: saved(w, "m.stl", w.mesh.export, tdf.load_mesh).vertices,
    "load_model": lambda w: saved(w, "w.safetensors", lambda path: tdf.save_model(w.model, path), tdf.load_model),
    "load_points": lambda w: saved(w, "c.npy", lambda path: np.save(path, w.points), tdf.load_points),
    "load_robot": lambda w: (lambda arm: (arm.home, arm.lower, arm.upper))(tdf.load_robot(home=w.up)),
    "load_trajectory": lambda w: saved(w, "t.npz", lambda path: tdf.save_trajectory(path, w.path), tdf.load_trajectory),
    "lowest_cost_path": lambda w: tdf.lowest_cost_path(w.landscape, w.zeros, (0.02, 0.02, 0)),
    "mesh_obstacle": lambda w: tdf.mesh_obstacle(w.mesh, 0.05),
    "optimize": lambda w: tdf.optimize(w.field, w.reference, KEY, config=ADAM),
    "path_grid": lambda w: tdf.path_grid(w.path, 0.1, 0.05).points,
    "pick_object": lambda w: tdf.pick_object(
        w.model, [w.cloud, w.points], w.reference, config=CARRY, return_choice=True
    ),
    "plan_joints": lambda w: (lambda moved: moved.positions[[0, len(moved.times) // 2]])(
        tdf.plan_joints(w.reached, w.arm, approach=w.short)
    ),
    "plane_grid": lambda w: tdf.plane_grid(0.1, 3, w.vector).points,
    "points_from_depth": lambda w: tdf.points_from_depth(w.seen, (30.0, 30, 15.5, 11.5), np.eye(4)),
    "pose_covariance": lambda w: (lambda found: (found, found.free, len(found.screws)))(
        tdf.pose_covariance(w.field, w.reference, w.pose)
    ),
    "pose_descriptor": lambda w: tdf.pose_descriptor(w.field, w.pose, w.query),
    "push_clear": lambda w: (
        tdf.push_clear(w.path, w.query, [w.near], config=tdf.ClearanceConfig(iterations=1)).trajectory
    ),
    "recognition": lambda w: tdf.recognition(w.residual, 0.1),
    "refine": lambda w: tdf.refine(w.model, w.field, w.cloud, steps=2),
    "relate": lambda w: tdf.relate(
        w.model,
        w.related,
        points=w.cloud,
        target_points=w.target.points,
        key=KEY,
        config=CARRY,
    ),
    "remove_outliers": lambda w: tdf.remove_outliers(w.cloud),
    "remove_plane": lambda w: tdf.remove_plane(w.scene),
    "resample": lambda w: tdf.resample(w.path, 5),
    "retime": lambda w: tdf.retime(w.axes, w.limits, w.limits),
    "rotation_grid": lambda w: tdf.rotation_grid(3),
    "sample_surface": lambda w: tdf.sample_surface(w.mesh, 5, 0),
    "semicircle": lambda w: tdf.semicircle(**SHAPE),
    "separate_objects": lambda w: tdf.separate_objects(w.scene),
    "snapped_query": lambda w: tdf.snapped_query(w.query, 0.01),
    "solve": lambda w: tdf.solve(w.field, w.reference, KEY, config=SOLVE),
    "surface_logit": lambda w: tdf.surface_logit(w.field, w.cloud),
    "thin": lambda w: tdf.thin(w.shown, 5),
    "tilt_and_pour": lambda w: tdf.tilt_and_pour(**SHAPE),
    "track": lambda w: tdf.track(w.field, w.reference, w.result, goal=w.goal),
    "trajectory_descriptor": lambda w: tdf.trajectory_descriptor(w.field, w.path, w.query),
    "trajectory_energy": lambda w: tdf.trajectory_energy(w.path, w.field, w.reference, tdf.EnergyWeights()),
    "turns": lambda w: tdf.turns(w.vector, 3, w.axes),
    "volume_grid": lambda w: tdf.volume_grid(0.1, 2).points,
    "wave": lambda w: tdf.wave(**SHAPE),
}
# Public names that need no call of their own, and why.
NO_CALL = {
    "available_models": "lists file names",
    "save_demonstration": "by load_demonstration",
    "save_imitation": "by load_imitation",
    "save_landscape": "by load_landscape",
    "save_model": "by load_model",
    "save_trajectory": "by load_trajectory",
    **dict.fromkeys(
        ("sample_bottle", "sample_bowl", "sample_container", "sample_mug", "sample_rack"), "numpy's generator alone"
    ),
    "Robot": "by load_robot",
    **dict.fromkeys(("EnergyWeights", "Model", "Reference"), "arrays that other calls make and take"),
    **dict.fromkeys(("CarryConfig", "ClearanceConfig", "OptimizeConfig", "SolveConfig"), "numbers of Python"),
    "TrackConfig": "numbers of Python",
    **dict.fromkeys(("BottleParameters", "BowlParameters", "MugParameters"), "numbers of Python"),
    **dict.fromkeys(("ContainerParameters", "RackParameters"), "numbers of Python"),
    **dict.fromkeys(("ModelInfo", "NetworkConfig"), "numbers of Python"),
}
# Those that need the extra "sim".
PHYSICS = ("load_robot", "plan_joints", "retime")
# Draws of other numbers where float64 is allowed, and what starts from them.
RANDOM = {"box_query", "carry", "contact_query", "gaussian_query", "gripper_query", "imitate", "imitate_batch"}
RANDOM |= {"optimize", "pick_object", "relate", "solve"}
# Those whose programs are small, or those of other tests, run with the fast ones.
FAST = ("Result", "box_query", "carry", "cluster_poses", "describe", "encode", "imitate", "load_model")
FAST += ("load_trajectory", "path_grid", "plane_grid", "confidence", "thin", "turns")
FAST_SETTINGS = ("rank promotion", "dtype promotion", "transfer guard")


def numbers(value) -> list[np.ndarray]:
    """All numbers of a result, in order."""
    if dataclasses.is_dataclass(value) and not isinstance(value, type) and not jax.tree.leaves(value) == [value]:
        return [np.asarray(leaf) for leaf in jax.tree.leaves(value)]
    if dataclasses.is_dataclass(value):
        return numbers([getattr(value, field.name) for field in dataclasses.fields(value)])
    if isinstance(value, dict):
        return numbers(list(value.values()))
    if isinstance(value, list | tuple):
        return [one for part in value for one in numbers(part)]
    return [] if value is None or isinstance(value, str) else [np.asarray(value)]


def plain(world, name):
    """The numbers of a call under no setting, computed once."""
    if name in PHYSICS:
        for module in ("mujoco", "mink", "toppra"):
            pytest.importorskip(module, reason="the extra 'sim' is not installed")
    if name not in world.plain:
        world.plain[name] = numbers(CALLS[name](world))
    return world.plain[name]


def assert_same(found, expected, tolerance=1e-5):
    assert [one.shape for one in found] == [one.shape for one in expected] and expected
    for one, other in zip(found, expected):
        np.testing.assert_allclose(
            np.asarray(one, np.float64), np.asarray(other, np.float64), rtol=tolerance, atol=tolerance
        )


def test_every_public_name_is_in_the_table():
    lines = (Path(__file__).parent / "public_names.txt").read_text().splitlines()
    errors = {name for name in tdf.__all__ if name.endswith(("Error", "Warning"))}
    names = {line.split("(")[0].split(":")[0] for line in lines} - errors
    assert set(CALLS) | set(NO_CALL) == names
    assert not set(CALLS) & set(NO_CALL)


@pytest.mark.parametrize(
    ("setting", "name"),
    [
        pytest.param(
            setting,
            name,
            marks=[] if name in FAST and setting in FAST_SETTINGS else pytest.mark.slow,
            id=f"{setting}-{name}",
        )
        for setting in SETTINGS
        for name in CALLS
    ],
)
def test_a_setting_changes_no_result(world, setting, name):
    expected = plain(world, name)
    with SETTINGS[setting]():
        found = CALLS[name](world)
    found = numbers(found)
    if setting != "x64":
        assert_same(found, expected)
        return
    if name in RANDOM:
        assert [one.shape for one in found] == [one.shape for one in expected]
    else:
        assert_same(found, expected, 1e-3)
    assert_same(numbers(CALLS[name](world)), expected)  # and what is known of the program in 64 bits is not mixed up


@pytest.mark.slow
@pytest.mark.parametrize("name", ["carry_trajectory", "pose_descriptor", "trajectory_energy"])
def test_no_result_needs_a_compilation(world, name):
    expected = plain(world, name)
    with jax.disable_jit():
        assert_same(numbers(CALLS[name](world)), expected)


# --- in functions that jit, vmap and grad trace ---


def followed(result):
    """Arrays of a solver's result that are known everywhere."""
    return result.trajectories, result.energies, result.candidate_history, result.initial_trajectories, result.loss


# Functions of one array that can be traced, and that array.
PURE = {
    "DescriptorField": (lambda w, x: (w.field.descriptors(x), w.field.occupancy(x)), "query"),
    "Trajectory": (
        lambda w, x: (lambda path: (path.rotations, path.matrices, path.transformed(w.pose), path.shifted(w.vector)))(
            tdf.Trajectory(x)
        ),
        "poses",
    ),
    "box_obstacle": (lambda w, x: tdf.box_obstacle(x, x + 0.1).distance(w.query), "vector"),
    "box_query": (lambda w, x: tdf.box_query(KEY, 4, size=x + 0.1, centre=x), "vector"),
    "carry_trajectory": (lambda w, x: tdf.carry_trajectory(tdf.Trajectory(x), x[1], x[2]), "poses"),
    "compensator_loss": (lambda w, x: tdf.compensator_loss(tdf.Trajectory(x)), "poses"),
    "correlation_loss": (
        lambda w, x: tdf.correlation_loss(tdf.Trajectory(x), w.field.origin, w.reference, pose_norm="metres_radians"),
        "poses",
    ),
    "describe": (
        lambda w, x: tdf.describe(w.model, tdf.Demonstration(x, w.path, w.query)).descriptors,
        "shown",
    ),
    "descriptor_loss": (lambda w, x: tdf.descriptor_loss(tdf.Trajectory(x), w.field, w.reference), "poses"),
    "differentiable_pick": (
        lambda w, x: tdf.differentiable_pick(w.field, dataclasses.replace(w.reference, query=x), w.pose).pose,
        "query",
    ),
    "displace": (lambda w, x: tdf.displace(w.path, x), "vector"),
    "encode": (lambda w, x: tdf.encode(w.model, x).latent, "shown"),
    "gaussian_query": (lambda w, x: tdf.gaussian_query(KEY, 4, centre=x), "vector"),
    "lattice_query": (lambda w, x: tdf.lattice_query((2, 1, 2), centre=x), "vector"),
    "obstacle.distance": (lambda w, x: (w.distances.distance(x), w.box.distance(x)), "query"),
    "pose_descriptor": (lambda w, x: tdf.pose_descriptor(w.field, x, w.query), "pose"),
    "resample": (lambda w, x: tdf.resample(tdf.Trajectory(x), 5), "poses"),
    "snapped_query": (lambda w, x: tdf.snapped_query(x, 0.01), "query"),
    "trajectory_descriptor": (lambda w, x: tdf.trajectory_descriptor(w.field, tdf.Trajectory(x), w.query), "poses"),
    "trajectory_energy": (
        lambda w, x: tdf.trajectory_energy(tdf.Trajectory(x), w.field, w.reference, tdf.EnergyWeights()),
        "poses",
    ),
    "EnergyWeights": (
        lambda w, x: tdf.trajectory_energy(w.path, w.field, w.reference, tdf.EnergyWeights(x[0], x[1], x[2])),
        "vector",
    ),
}
# As well, but without a reverse-mode derivative.
NO_GRADIENT = {
    "carry": (lambda w, x: followed(tdf.carry(w.field, w.reference, KEY, goal=x, config=CARRY)), "goal"),
    "pose_covariance": (lambda w, x: tdf.pose_covariance(w.field, w.reference, x).covariance, "pose"),
    "solve": (lambda w, x: followed(tdf.solve(w.field, w.reference, KEY, goal=x, config=SOLVE)), "goal"),
    "track": (lambda w, x: followed(tdf.track(w.field, w.reference, w.result, goal=x)), "goal"),
}
# Functions of one array that compute with its numbers.
REFUSED = {
    "clearance": (lambda w, x: tdf.clearance(tdf.Trajectory(x), w.query, [w.box]), "poses"),
    "cloud_obstacle": (lambda w, x: tdf.cloud_obstacle(x), "shown"),
    "cluster_poses": (lambda w, x: tdf.cluster_poses(x, w.steps), "poses"),
    "confidence": (lambda w, x: tdf.confidence(x), "residual"),
    "contact_query": (lambda w, x: tdf.contact_query(x, w.points, KEY), "shown"),
    "drop_invalid": (lambda w, x: tdf.drop_invalid(x), "shown"),
    "energy_landscape": (lambda w, x: tdf.energy_landscape(w.field, w.reference, w.grid, x), "axes"),
    "field_obstacle": (lambda w, x: tdf.field_obstacle(w.field, x), "shown"),
    "gripper_query": (lambda w, x: tdf.gripper_query(KEY, 4, finger=x), "vector"),
    "hang_on_rack": (lambda w, x: tdf.hang_on_rack(4, approach=x), "vector"),
    "JointTrajectory": (lambda w, x: tdf.JointTrajectory(x, w.axes, ("a", "b", "c"), w.openings), "steps"),
    "ImitationScene": (lambda w, x: tdf.ImitationScene(w.demonstration, x, w.result), "shown"),
    "imitate": (lambda w, x: tdf.imitate(w.model, w.demonstration, x, key=KEY, config=CARRY), "shown"),
    "imitate_batch": (lambda w, x: tdf.imitate_batch(w.model, w.demonstration, [x], key=KEY, config=CARRY), "shown"),
    "lift_over": (lambda w, x: tdf.lift_over(4, start=x), "vector"),
    "line": (lambda w, x: tdf.line(4, start=x), "vector"),
    "load_robot": (lambda w, x: tdf.load_robot(home=x), "vector"),
    "lowest_cost_path": (lambda w, x: tdf.lowest_cost_path(w.landscape, x, (0, 0, 0)), "vector"),
    "optimize": (lambda w, x: tdf.optimize(w.field, w.reference, KEY, starts=x[None]), "poses"),
    "pick_object": (lambda w, x: tdf.pick_object(w.model, [x], w.reference, config=CARRY), "shown"),
    "plan_joints": (lambda w, x: tdf.plan_joints(tdf.Trajectory(x), None), "poses"),
    "path_grid": (lambda w, x: tdf.path_grid(tdf.Trajectory(x), 0.1, 0.05), "poses"),
    "plane_grid": (lambda w, x: tdf.plane_grid(0.1, origin=x), "vector"),
    "points_from_depth": (lambda w, x: tdf.points_from_depth(x, (30.0, 30, 15.5, 11.5)), "shown"),
    "push_clear": (lambda w, x: tdf.push_clear(tdf.Trajectory(x), w.query, [w.near]), "poses"),
    "recognition": (lambda w, x: tdf.recognition(x, 0.1), "residual"),
    "refine": (lambda w, x: tdf.refine(w.model, w.field, x), "shown"),
    "relate": (lambda w, x: tdf.relate(w.model, w.demonstration, points=x, key=KEY, config=CARRY), "shown"),
    "remove_outliers": (lambda w, x: tdf.remove_outliers(x), "shown"),
    "remove_plane": (lambda w, x: tdf.remove_plane(x), "shown"),
    "retime": (lambda w, x: tdf.retime(x, 1.0, 1.0), "axes"),
    "save_trajectory": (lambda w, x: tdf.save_trajectory(w.folder / "x.npz", tdf.Trajectory(x)), "poses"),
    "semicircle": (lambda w, x: tdf.semicircle(4, start=x), "vector"),
    "separate_objects": (lambda w, x: tdf.separate_objects(x), "shown"),
    "surface_logit": (lambda w, x: tdf.surface_logit(w.field, x), "shown"),
    "thin": (lambda w, x: tdf.thin(x, 5), "shown"),
    "tilt_and_pour": (lambda w, x: tdf.tilt_and_pour(4, start=x), "vector"),
    "turns": (lambda w, x: tdf.turns(x, 3), "vector"),
    "volume_grid": (lambda w, x: tdf.volume_grid(0.1, origin=x), "vector"),
    "wave": (lambda w, x: tdf.wave(4, start=x), "vector"),
}
# Names whose arguments are files, numbers of Python, or what other names of the tables are made of.
NOT_TRACED = {
    *("Demonstration", "Grid", "Landscape", "Result", "Target", "build_bottle", "build_bowl", "build_container"),
    *("build_mug", "build_rack", "convert_checkpoint", "load_demonstration", "load_landscape", "load_mesh"),
    *(
        "load_imitation",
        "load_joint_trajectory",
        "load_model",
        "load_points",
        "load_trajectory",
        "mesh_obstacle",
        "rotation_grid",
        "sample_surface",
    ),
}


def test_every_call_is_traced_or_refused():
    tables = [set(PURE) - {"obstacle.distance", "EnergyWeights"}, set(NO_GRADIENT), set(REFUSED) - {"save_trajectory"}]
    assert set().union(*tables) | NOT_TRACED == set(CALLS)
    assert sum(map(len, tables)) + len(NOT_TRACED) == len(CALLS)


FAST_TRACED = ("box_query", "displace")


@pytest.mark.parametrize(
    "name",
    [pytest.param(name, marks=[] if name in FAST_TRACED else pytest.mark.slow) for name in (*PURE, *NO_GRADIENT)],
)
def test_pure_functions_in_transformations_under_all_settings(world, name):
    function, argument = (PURE | NO_GRADIENT)[name]
    x = getattr(world, argument)

    def total(x):
        return sum(jnp.sum(jnp.asarray(leaf)) for leaf in jax.tree.leaves(function(world, x)))

    expected = np.asarray(total(x))
    batch = jnp.stack([x, x])
    transformed = jax.value_and_grad(total) if name in PURE else total
    with contextlib.ExitStack() as stack:
        for setting in ("rank promotion", "dtype promotion", "transfer guard"):
            stack.enter_context(SETTINGS[setting]())
        found = jax.jit(jax.vmap(transformed))(batch)
    value, slopes = (np.asarray(part) for part in (found if name in PURE else (found, x)))
    np.testing.assert_allclose(value, [expected, expected], rtol=1e-3, atol=1e-5)
    assert np.isfinite(slopes).all() and (slopes.any() or name == "snapped_query")


@pytest.mark.parametrize("transform", [jax.jit, jax.vmap, jax.grad], ids=lambda transform: transform.__name__)
@pytest.mark.parametrize("name", REFUSED)
def test_what_needs_known_numbers_is_refused_by_name(world, name, transform):
    function, argument = REFUSED[name]
    x = getattr(world, argument)
    for needed in ("box", "near", "landscape", "vector", "steps", "openings", "limits"):
        getattr(world, needed)  # made before anything is traced
    with pytest.raises(tdf.InputError, match=rf"{name}\(\): .* traced by jax.jit"):
        transform(lambda x: function(world, x))(jnp.stack([x, x]) if transform is jax.vmap else x)


@pytest.mark.parametrize("name", ["clearance", "energy_landscape", "imitate", "optimize", "push_clear"])
def test_known_numbers_inside_jit_are_refused_by_name(world, name):
    assert world.box and world.near and world.grid  # made before anything is traced
    with pytest.raises(tdf.InputError, match=rf"{name}\(\): it is called inside a function that jax.jit traces"):
        jax.jit(lambda x: (CALLS[name](world), x)[1])(1.0)


# --- arrays of other libraries ---


class Tensor:
    """As a tensor of PyTorch that requires a gradient."""

    def __init__(self, values):
        self.values = np.asarray(values)

    shape = property(lambda self: self.values.shape)
    ndim = property(lambda self: self.values.ndim)
    dtype = property(lambda self: f"torch.{self.values.dtype}")

    def __len__(self):
        return len(self.values)

    def __getitem__(self, index):
        return Tensor(self.values[index])

    def __array__(self, dtype=None, copy=None):
        raise RuntimeError("Can't call numpy() on Tensor that requires grad. Use tensor.detach().numpy() instead.")

    def detach(self):
        return self.values


FOREIGN = {
    "encode": lambda w, x: tdf.encode(w.model, x(w.points)),
    "describe": lambda w, x: tdf.describe(w.model, tdf.Demonstration(x(w.points), w.path, x(w.query))),
    "imitate": lambda w, x: tdf.imitate(w.model, w.reference, x(w.cloud), key=KEY, goal=x(w.goal), config=CARRY),
    "imitate_batch": lambda w, x: tdf.imitate_batch(w.model, w.reference, [x(w.cloud)], key=KEY, config=CARRY),
    "thin": lambda w, x: tdf.thin(x(w.points), 5),
    "drop_invalid": lambda w, x: tdf.drop_invalid(x(w.points)),
    "carry_trajectory": lambda w, x: tdf.carry_trajectory(w.path, x(w.goal), x(w.pose)),
    "pose_descriptor": lambda w, x: tdf.pose_descriptor(w.field, x(w.pose), x(w.query)),
    "cluster_poses": lambda w, x: tdf.cluster_poses(x(w.picks), x(w.result.energies)),
    "box_query": lambda w, x: tdf.box_query(KEY, 4, centre=x(w.vector)),
    "turns": lambda w, x: tdf.turns(x(w.vector), 3),
    "line": lambda w, x: tdf.line(4, x(w.vector)),
    "plane_grid": lambda w, x: tdf.plane_grid(0.1, 3, x(w.vector)).points,
}
KINDS = {
    "tensor": Tensor,
    "masked": lambda x: np.ma.masked_array(np.asarray(x)),
    "list": lambda x: np.asarray(x).tolist(),
    "read-only": lambda x: np.frombuffer(np.asarray(x).tobytes(), np.asarray(x).dtype).reshape(np.shape(x)),
    "matrix order": lambda x: np.asfortranarray(x),
    "float64": lambda x: np.asarray(x, np.float64),
}


@pytest.mark.parametrize(
    ("name", "kind"),
    [pytest.param(name, kind, marks=[] if name in FAST else [pytest.mark.slow]) for name in FOREIGN for kind in KINDS],
)
def test_arrays_of_other_libraries_give_the_same_result(world, name, kind):
    expected = numbers(FOREIGN[name](world, np.asarray))
    assert_same(numbers(FOREIGN[name](world, KINDS[kind])), expected)


@pytest.mark.parametrize("name", FOREIGN)
def test_masked_numbers_are_refused_by_name(world, name):
    def masked(x):
        mask = np.zeros(np.shape(x), bool)
        mask.flat[-1] = True
        return np.ma.masked_array(np.asarray(x), mask)

    with pytest.raises(tdf.InputError, match=r"\(\): 1 of the \d+ numbers of \w+ are masked"):
        FOREIGN[name](world, masked)


def test_a_trajectory_of_another_library_is_refused_by_name(world):
    for kind in ("tensor", "masked", "list"):
        poses = tdf.Trajectory(KINDS[kind](world.poses))
        for call in (
            lambda poses=poses: tdf.Demonstration(world.points, poses, world.query),
            lambda poses=poses: tdf.resample(poses, 5),
        ):
            with pytest.raises(tdf.InputError, match="trajectory.wxyz_xyz is a .*; expected an array"):
                call()


def test_tensors_of_pytorch_and_tables_of_pandas(world):
    """The classes above are as the libraries' own."""
    torch, pandas = pytest.importorskip("torch"), pytest.importorskip("pandas")
    expected = numbers(tdf.encode(world.model, world.points))
    tensor = torch.tensor(world.points, requires_grad=True)
    assert_same(numbers(tdf.encode(world.model, tensor)), expected)
    table = pandas.DataFrame(world.points[:, [2, 0, 1]], columns=["z", "x", "y"])
    assert_same(numbers(tdf.encode(world.model, table)), expected)
    with pytest.raises(tdf.InputError, match="points has dtype object"):
        tdf.encode(world.model, table.astype({"x": str}))


# --- a platform that is not there ---


def test_a_missing_platform_is_one_line_and_exit_code_2(tmp_path):
    """In the library an InputError; of a command no traceback."""
    script = (
        "import tdf_jax as tdf\n"
        "from tdf_jax.cli.main import main\n"
        "try: tdf.load_model('mug')\n"
        "except tdf.InputError as error: print(error)\n"
        f"main(['convert', {str(FIXTURES / 'ndf_latent32.pth')!r}, {str(tmp_path / 'a.safetensors')!r}])\n"
    )
    settings = {"JAX_PLATFORMS": "cuda", "JAX_NUMPY_RANK_PROMOTION": "raise"}
    ended = subprocess.run([sys.executable, "-c", script], env=os.environ | settings, capture_output=True, text=True)
    expected = "JAX has no device of the platform 'cuda', which JAX_PLATFORMS or jax_platforms asks for"
    assert ended.returncode == 2 and expected in ended.stderr and "Traceback" not in ended.stderr
    assert ended.stdout.startswith(f"load_model(): {expected}") and ended.stdout.count("\n") == 1
