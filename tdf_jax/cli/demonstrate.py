"""`tdf demonstrate`: a demonstration from a recorded motion and a cloud."""

import dataclasses
from pathlib import Path
from typing import Annotated

import jax
import jax.numpy as jnp
import numpy as np
import tyro

from tdf_jax._internal import checks
from tdf_jax._internal.errors import InputError
from tdf_jax.geometry import se3
from tdf_jax.geometry.demonstration import Demonstration
from tdf_jax.geometry.query import box_query, contact_query
from tdf_jax.geometry.target import Target
from tdf_jax.io.demonstrations import check_frames, save_demonstration
from tdf_jax.io.pointclouds import load_points
from tdf_jax.io.trajectories import load_trajectory


def demonstrate(
    points: Annotated[Path, tyro.conf.arg(metavar="FILE")],
    trajectory: Annotated[Path, tyro.conf.arg(metavar="FILE")],
    query_box: Annotated[tuple[float, ...], tyro.conf.arg(metavar="EDGE | X Y Z")],
    out: Annotated[Path, tyro.conf.arg(metavar="FILE")],
    query_centre: Annotated[tuple[float, float, float], tyro.conf.arg(metavar="X Y Z")] = (0.0, 0.0, 0.0),
    queries: int = 128,
    grasp: int = 0,
    release: int = -1,
    num_poses: Annotated[
        int | None, tyro.conf.arg(metavar="INT", help_behavior_hint="(default: those of the file)")
    ] = None,
    scale: float = 1.0,
    drop_invalid: bool = False,
    count: Annotated[
        int | None, tyro.conf.arg(metavar="INT", help_behavior_hint="(default: 1500 of a mesh, all of a cloud)")
    ] = None,
    seed: int = 0,
    target_object: Annotated[Path | None, tyro.conf.arg(metavar="FILE", help_behavior_hint="(default: none)")] = None,
    contacts: int = 128,
) -> None:
    """Make a demonstration file for `tdf imitate --demonstration` from a recorded motion and a cloud.

    Args:
        points: point cloud or mesh of the demonstrated object before the grasp, in the frame of the trajectory.
        trajectory: recorded poses of the query frame, such as the gripper's, in the order of the motion: .tum, .csv
            with the columns x y z qx qy qz qw, or .npz; metres.
        query_box: edge lengths of the box of query points in the query frame, metres: the part of the object that the
            gripper touches.
        out: .npz file to write.
        query_centre: centre of the box, metres, query frame.
        queries: number of query points.
        grasp: index of the pose at which the object is grasped; the first is 0.
        release: index of the pose at which it is released; negative indices count from the end.
        num_poses: number of poses from the grasp to the release after resampling.
        scale: metres per unit of the points file, such as 0.01 for centimetres.
        drop_invalid: remove points that are NaN or stand for missing measurements.
        count: number of points that are sampled from a mesh or a larger cloud.
        seed: seed of the query points and of the sampled points.
        target_object: point cloud or mesh of the object that the first one is placed on or in, as it stands at the
            release, in the unit of the points file; `tdf imitate --target-object` then finds the goal on a new one.
        contacts: number of contact points, drawn where the two objects meet at the release; the contact frame has its
            origin in their middle, and the axes of the trajectory's frame.
    """
    command = "tdf demonstrate"
    if len(query_box) not in (1, 3):
        raise InputError(f"{command}: --query-box has {len(query_box)} numbers; expected one edge, or three")
    checks.seed(command, seed, "--seed")
    size = query_box[0] if len(query_box) == 1 else query_box
    query = box_query(jax.random.key(seed), queries, size, query_centre)
    cloud = load_points(points, count, scale, seed, drop_invalid=drop_invalid)
    recorded = load_trajectory(trajectory)
    check_frames(command, cloud, recorded, query, grasp)
    demonstration = Demonstration(cloud, recorded, query, grasp, release)
    if target_object is not None:
        # With another seed, because samples of one mesh by one seed are the same points.
        placed = load_points(target_object, count, scale, (seed + 1) % checks.SEEDS, drop_invalid=drop_invalid)
        moved = se3.transform(demonstration.object_motion, jnp.asarray(cloud))
        region = contact_query(moved, placed, jax.random.fold_in(jax.random.key(seed), 1), contacts)
        # The contact frame is at its points: poses of a far one would move with every turn, and distinct solutions are
        # told apart by the translations of their poses.
        centre = np.asarray(region, float).mean(axis=0)
        target = Target(placed, region - centre, np.concatenate([[1.0, 0.0, 0.0, 0.0], centre]))
        demonstration = dataclasses.replace(demonstration, target=target)
    if num_poses is not None:
        demonstration = demonstration.resampled(num_poses)
    save_demonstration(out, demonstration)
    parts = (demonstration.approach, demonstration.transfer, demonstration.retreat)
    before, during, after = (part.num_poses for part in parts)
    print(f"saved {out}: {len(cloud)} points, {before} poses before the grasp, {during} to the release, {after} after")
