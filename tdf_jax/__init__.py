"""Imitate a demonstrated pick-and-place trajectory on new objects: Trajectory Descriptor Fields in JAX.

    mesh or cloud file --load_mesh, load_points, sample_surface--> points
    depth image --points_from_depth, separate_objects--> points
    points --encode--> DescriptorField
    Demonstration (points, trajectory, query points) --describe--> Reference
    DescriptorField + Reference --carry, solve or optimize--> Result, whose `.trajectory` is the best one
    Trajectory + obstacles --push_clear--> Trajectory
    Trajectory + Robot --plan_joints--> JointTrajectory

`imitate` goes the whole way in one call; with a `Target` it finds the goal on a second object. Lengths are in metres,
angles in radians, poses `wxyz_xyz` as in jaxlie, and `T_world_query` is the pose of the query frame in the world.
"""

from tdf_jax import plot as plot
from tdf_jax._internal.errors import (
    CategoryWarning as CategoryWarning,
    ConfidenceWarning as ConfidenceWarning,
    ForeignPointsWarning as ForeignPointsWarning,
    InputError as InputError,
    InvalidPointsWarning as InvalidPointsWarning,
    SizeWarning as SizeWarning,
    TdfWarning as TdfWarning,
)
from tdf_jax._internal.version import __version__ as __version__
from tdf_jax.energy.descriptors import (
    pose_descriptor as pose_descriptor,
    trajectory_descriptor as trajectory_descriptor,
)
from tdf_jax.energy.losses import (
    EnergyWeights as EnergyWeights,
    compensator_loss as compensator_loss,
    correlation_loss as correlation_loss,
    descriptor_loss as descriptor_loss,
    trajectory_energy as trajectory_energy,
)
from tdf_jax.energy.reference import Reference as Reference, describe as describe
from tdf_jax.geometry.demonstration import Demonstration as Demonstration
from tdf_jax.geometry.distance_fields import (
    box_obstacle as box_obstacle,
    cloud_obstacle as cloud_obstacle,
    mesh_obstacle as mesh_obstacle,
)
from tdf_jax.geometry.grid import (
    Grid as Grid,
    path_grid as path_grid,
    plane_grid as plane_grid,
    volume_grid as volume_grid,
)
from tdf_jax.geometry.paths import (
    hang_on_rack as hang_on_rack,
    lift_over as lift_over,
    line as line,
    semicircle as semicircle,
    tilt_and_pour as tilt_and_pour,
    wave as wave,
)
from tdf_jax.geometry.query import (
    box_query as box_query,
    contact_query as contact_query,
    gaussian_query as gaussian_query,
    gripper_query as gripper_query,
    lattice_query as lattice_query,
    snapped_query as snapped_query,
)
from tdf_jax.geometry.sampling import (
    drop_invalid as drop_invalid,
    sample_surface as sample_surface,
    thin as thin,
)
from tdf_jax.geometry.se3 import rotation_grid as rotation_grid, turns as turns
from tdf_jax.geometry.target import Target as Target
from tdf_jax.geometry.trajectory import Trajectory as Trajectory, displace as displace, resample as resample
from tdf_jax.geometry.transport import carry_trajectory as carry_trajectory
from tdf_jax.imitation import imitate as imitate, imitate_batch as imitate_batch
from tdf_jax.io.demonstrations import (
    load_demonstration as load_demonstration,
    save_demonstration as save_demonstration,
)
from tdf_jax.io.meshes import load_mesh as load_mesh
from tdf_jax.io.pointclouds import load_points as load_points
from tdf_jax.io.trajectories import load_trajectory as load_trajectory, save_trajectory as save_trajectory
from tdf_jax.landscape.energy_grid import energy_landscape as energy_landscape
from tdf_jax.landscape.shortest_path import lowest_cost_path as lowest_cost_path
from tdf_jax.landscape.storage import (
    Landscape as Landscape,
    load_landscape as load_landscape,
    save_landscape as save_landscape,
)
from tdf_jax.networks.checkpoint import (
    available_models as available_models,
    load_model as load_model,
    save_model as save_model,
)
from tdf_jax.networks.encoding import encode as encode
from tdf_jax.networks.field import DescriptorField as DescriptorField
from tdf_jax.networks.model import Model as Model, ModelInfo as ModelInfo
from tdf_jax.networks.ndf_checkpoint import convert_checkpoint as convert_checkpoint
from tdf_jax.networks.occupancy import NetworkConfig as NetworkConfig
from tdf_jax.networks.refinement import refine as refine
from tdf_jax.perception.choice import pick_object as pick_object
from tdf_jax.perception.clusters import separate_objects as separate_objects
from tdf_jax.perception.depth import points_from_depth as points_from_depth
from tdf_jax.perception.outliers import remove_outliers as remove_outliers
from tdf_jax.perception.support import remove_plane as remove_plane
from tdf_jax.planning.avoidance import ClearanceConfig as ClearanceConfig, push_clear as push_clear
from tdf_jax.planning.distances import clearance as clearance
from tdf_jax.planning.occupied import field_obstacle as field_obstacle
from tdf_jax.relation.object_motion import relate as relate
from tdf_jax.shapes import (
    BottleParameters as BottleParameters,
    BowlParameters as BowlParameters,
    ContainerParameters as ContainerParameters,
    MugParameters as MugParameters,
    RackParameters as RackParameters,
    build_bottle as build_bottle,
    build_bowl as build_bowl,
    build_container as build_container,
    build_mug as build_mug,
    build_rack as build_rack,
    sample_bottle as sample_bottle,
    sample_bowl as sample_bowl,
    sample_container as sample_container,
    sample_mug as sample_mug,
    sample_rack as sample_rack,
)
from tdf_jax.sim.joint_trajectory import (
    JointTrajectory as JointTrajectory,
    load_joint_trajectory as load_joint_trajectory,
)
from tdf_jax.sim.motion import plan_joints as plan_joints
from tdf_jax.sim.retiming import retime as retime
from tdf_jax.sim.robot import Robot as Robot, load_robot as load_robot
from tdf_jax.solvers.adam import OptimizeConfig as OptimizeConfig, optimize as optimize
from tdf_jax.solvers.imitation_scene import (
    ImitationScene as ImitationScene,
    load_imitation as load_imitation,
    save_imitation as save_imitation,
)
from tdf_jax.solvers.multistart import SolveConfig as SolveConfig, solve as solve
from tdf_jax.solvers.pick import CarryConfig as CarryConfig, carry as carry
from tdf_jax.solvers.result import Result as Result
from tdf_jax.solvers.sensitivity import differentiable_pick as differentiable_pick
from tdf_jax.solvers.tracking import TrackConfig as TrackConfig, track as track
from tdf_jax.uncertainty.calibration import (
    confidence as confidence,
    recognition as recognition,
    surface_logit as surface_logit,
)
from tdf_jax.uncertainty.covariance import pose_covariance as pose_covariance
from tdf_jax.uncertainty.modes import cluster_poses as cluster_poses

__all__ = [
    "available_models",
    "BottleParameters",
    "BowlParameters",
    "box_obstacle",
    "box_query",
    "build_bottle",
    "build_bowl",
    "build_container",
    "build_mug",
    "build_rack",
    "carry",
    "carry_trajectory",
    "CarryConfig",
    "CategoryWarning",
    "clearance",
    "ClearanceConfig",
    "cloud_obstacle",
    "cluster_poses",
    "compensator_loss",
    "confidence",
    "ConfidenceWarning",
    "contact_query",
    "ContainerParameters",
    "convert_checkpoint",
    "correlation_loss",
    "Demonstration",
    "describe",
    "descriptor_loss",
    "DescriptorField",
    "differentiable_pick",
    "displace",
    "drop_invalid",
    "encode",
    "energy_landscape",
    "EnergyWeights",
    "field_obstacle",
    "ForeignPointsWarning",
    "gaussian_query",
    "Grid",
    "gripper_query",
    "hang_on_rack",
    "imitate",
    "imitate_batch",
    "ImitationScene",
    "InputError",
    "InvalidPointsWarning",
    "JointTrajectory",
    "Landscape",
    "lattice_query",
    "lift_over",
    "line",
    "load_demonstration",
    "load_imitation",
    "load_joint_trajectory",
    "load_landscape",
    "load_mesh",
    "load_model",
    "load_points",
    "load_robot",
    "load_trajectory",
    "lowest_cost_path",
    "mesh_obstacle",
    "Model",
    "ModelInfo",
    "MugParameters",
    "NetworkConfig",
    "optimize",
    "OptimizeConfig",
    "path_grid",
    "pick_object",
    "plan_joints",
    "plane_grid",
    "plot",
    "points_from_depth",
    "pose_covariance",
    "pose_descriptor",
    "push_clear",
    "RackParameters",
    "recognition",
    "Reference",
    "refine",
    "relate",
    "remove_outliers",
    "remove_plane",
    "resample",
    "Result",
    "retime",
    "Robot",
    "rotation_grid",
    "sample_bottle",
    "sample_bowl",
    "sample_container",
    "sample_mug",
    "sample_rack",
    "sample_surface",
    "save_demonstration",
    "save_imitation",
    "save_landscape",
    "save_model",
    "save_trajectory",
    "semicircle",
    "separate_objects",
    "SizeWarning",
    "snapped_query",
    "solve",
    "SolveConfig",
    "surface_logit",
    "Target",
    "TdfWarning",
    "thin",
    "tilt_and_pour",
    "track",
    "TrackConfig",
    "Trajectory",
    "trajectory_descriptor",
    "trajectory_energy",
    "turns",
    "volume_grid",
    "wave",
]


def __getattr__(name: str):
    if name == "poses":  # the module's name in the release before
        from tdf_jax._internal.deprecation import warn
        from tdf_jax.geometry import se3

        warn("tdf_jax.poses", "tdf_jax.turns and tdf_jax.rotation_grid")
        return se3
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
