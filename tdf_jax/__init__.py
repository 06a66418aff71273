"""Imitate a demonstrated pick-and-place trajectory on new objects: Trajectory Descriptor Fields in JAX."""

from tdf_jax._internal.errors import CategoryWarning as CategoryWarning
from tdf_jax._internal.errors import InputError as InputError
from tdf_jax.energy.descriptors import pose_descriptor as pose_descriptor
from tdf_jax.energy.descriptors import trajectory_descriptor as trajectory_descriptor
from tdf_jax.energy.losses import EnergyWeights as EnergyWeights
from tdf_jax.energy.losses import compensator_loss as compensator_loss
from tdf_jax.energy.losses import correlation_loss as correlation_loss
from tdf_jax.energy.losses import descriptor_loss as descriptor_loss
from tdf_jax.energy.losses import trajectory_energy as trajectory_energy
from tdf_jax.geometry.demonstration import Demonstration as Demonstration
from tdf_jax.energy.reference import Reference as Reference
from tdf_jax.energy.reference import describe as describe
from tdf_jax.geometry.grid import Grid as Grid
from tdf_jax.geometry.grid import path_grid as path_grid
from tdf_jax.geometry.grid import plane_grid as plane_grid
from tdf_jax.geometry.grid import volume_grid as volume_grid
from tdf_jax.geometry.paths import hang_on_rack as hang_on_rack
from tdf_jax.geometry.paths import lift_over as lift_over
from tdf_jax.geometry.paths import line as line
from tdf_jax.geometry.paths import semicircle as semicircle
from tdf_jax.geometry.paths import tilt_and_pour as tilt_and_pour
from tdf_jax.geometry.paths import wave as wave
from tdf_jax.geometry.query import box_query as box_query
from tdf_jax.geometry.query import gaussian_query as gaussian_query
from tdf_jax.geometry.query import gripper_query as gripper_query
from tdf_jax.geometry.query import lattice_query as lattice_query
from tdf_jax.geometry.query import snapped_query as snapped_query
from tdf_jax.geometry.se3 import rotation_grid as rotation_grid
from tdf_jax.geometry.se3 import turns as turns
from tdf_jax.geometry.trajectory import Trajectory as Trajectory
from tdf_jax.geometry.trajectory import displace as displace
from tdf_jax.io.trajectories import load_trajectory as load_trajectory
from tdf_jax.geometry.trajectory import resample as resample
from tdf_jax.io.trajectories import save_trajectory as save_trajectory
from tdf_jax.imitation import imitate as imitate
from tdf_jax.imitation import imitate_batch as imitate_batch
from tdf_jax.io.meshes import load_mesh as load_mesh
from tdf_jax.geometry.sampling import sample_surface as sample_surface
from tdf_jax.io.pointclouds import load_points as load_points
from tdf_jax.geometry.sampling import thin as thin
from tdf_jax.landscape.energy_grid import energy_landscape as energy_landscape
from tdf_jax.landscape.shortest_path import lowest_cost_path as lowest_cost_path
from tdf_jax.landscape.storage import Landscape as Landscape
from tdf_jax.landscape.storage import load_landscape as load_landscape
from tdf_jax.landscape.storage import save_landscape as save_landscape
from tdf_jax.networks.checkpoint import available_models as available_models
from tdf_jax.networks.checkpoint import load_model as load_model
from tdf_jax.networks.checkpoint import save_model as save_model
from tdf_jax.networks.field import DescriptorField as DescriptorField
from tdf_jax.networks.model import Model as Model
from tdf_jax.networks.model import ModelInfo as ModelInfo
from tdf_jax.networks.encoding import encode as encode
from tdf_jax.networks.ndf_checkpoint import convert_checkpoint as convert_checkpoint
from tdf_jax.networks.occupancy import NetworkConfig as NetworkConfig
from tdf_jax.networks.refinement import refine as refine
from tdf_jax.planning.avoidance import ClearanceConfig as ClearanceConfig
from tdf_jax.planning.distances import clearance as clearance
from tdf_jax.planning.avoidance import push_clear as push_clear
from tdf_jax.geometry.distance_fields import box_obstacle as box_obstacle
from tdf_jax.geometry.distance_fields import cloud_obstacle as cloud_obstacle
from tdf_jax.planning.occupied import field_obstacle as field_obstacle
from tdf_jax.geometry.distance_fields import mesh_obstacle as mesh_obstacle
from tdf_jax.shapes import BottleParameters as BottleParameters
from tdf_jax.shapes import BowlParameters as BowlParameters
from tdf_jax.shapes import MugParameters as MugParameters
from tdf_jax.shapes import build_bottle as build_bottle
from tdf_jax.shapes import build_bowl as build_bowl
from tdf_jax.shapes import build_mug as build_mug
from tdf_jax.shapes import sample_bottle as sample_bottle
from tdf_jax.shapes import sample_bowl as sample_bowl
from tdf_jax.shapes import sample_mug as sample_mug
from tdf_jax.solvers.adam import OptimizeConfig as OptimizeConfig
from tdf_jax.solvers.result import Result as Result
from tdf_jax.solvers.adam import optimize as optimize
from tdf_jax.solvers.multistart import SolveConfig as SolveConfig
from tdf_jax.solvers.multistart import solve as solve
from tdf_jax.solvers.pick import CarryConfig as CarryConfig
from tdf_jax.solvers.pick import carry as carry
from tdf_jax.geometry.transport import carry_trajectory as carry_trajectory
from tdf_jax.uncertainty.calibration import confidence as confidence
from tdf_jax.uncertainty.calibration import recognition as recognition
from tdf_jax.uncertainty.calibration import surface_logit as surface_logit
from tdf_jax.uncertainty.modes import cluster_poses as cluster_poses
from tdf_jax.uncertainty.covariance import pose_covariance as pose_covariance

__version__ = "0.1.0"

__all__ = [
    "available_models",
    "BottleParameters",
    "BowlParameters",
    "box_obstacle",
    "box_query",
    "build_bottle",
    "build_bowl",
    "build_mug",
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
    "convert_checkpoint",
    "correlation_loss",
    "Demonstration",
    "describe",
    "descriptor_loss",
    "DescriptorField",
    "displace",
    "encode",
    "energy_landscape",
    "EnergyWeights",
    "field_obstacle",
    "gaussian_query",
    "Grid",
    "gripper_query",
    "hang_on_rack",
    "imitate",
    "imitate_batch",
    "InputError",
    "Landscape",
    "lattice_query",
    "lift_over",
    "line",
    "load_landscape",
    "load_mesh",
    "load_model",
    "load_points",
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
    "plane_grid",
    "pose_covariance",
    "pose_descriptor",
    "push_clear",
    "recognition",
    "Reference",
    "refine",
    "resample",
    "Result",
    "rotation_grid",
    "sample_bottle",
    "sample_bowl",
    "sample_mug",
    "sample_surface",
    "save_landscape",
    "save_model",
    "save_trajectory",
    "semicircle",
    "snapped_query",
    "solve",
    "SolveConfig",
    "surface_logit",
    "thin",
    "tilt_and_pour",
    "Trajectory",
    "trajectory_descriptor",
    "trajectory_energy",
    "turns",
    "volume_grid",
    "wave",
]


def __getattr__(name: str):
    if name == "poses":  # the module's name in the release before
        import warnings

        from tdf_jax.geometry import se3

        warnings.warn("tdf_jax.poses is deprecated; use tdf_jax.turns and tdf_jax.rotation_grid", DeprecationWarning, stacklevel=2)
        return se3
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
