"""Imitate a demonstrated pick-and-place trajectory on new objects: Trajectory Descriptor Fields in JAX."""

from tdf_jax.carry import CarryConfig, carry, carry_trajectory
from tdf_jax.checkpoint import available_models, load_model, save_model
from tdf_jax.clearance import ClearanceConfig, clearance, push_clear
from tdf_jax.confidence import confidence
from tdf_jax.convert import convert_checkpoint
from tdf_jax.demonstration import Demonstration, Reference, describe
from tdf_jax.descriptor import pose_descriptor, trajectory_descriptor
from tdf_jax.energy import (
    EnergyWeights,
    compensator_loss,
    correlation_loss,
    descriptor_loss,
    trajectory_energy,
)
from tdf_jax.errors import CategoryWarning, InputError
from tdf_jax.field import DescriptorField
from tdf_jax.grid import Grid, path_grid, plane_grid, volume_grid
from tdf_jax.imitation import imitate, imitate_batch
from tdf_jax.landscape import Landscape, load_landscape, save_landscape
from tdf_jax.meshes import load_mesh, sample_surface
from tdf_jax.model import Model, ModelInfo, encode
from tdf_jax.modes import cluster_poses, pose_covariance
from tdf_jax.network import NetworkConfig
from tdf_jax.obstacles import box_obstacle, cloud_obstacle, field_obstacle, mesh_obstacle
from tdf_jax.optimize import OptimizeConfig, Result, optimize
from tdf_jax.paths import hang_on_rack, lift_over, line, semicircle, tilt_and_pour, wave
from tdf_jax.pointcloud import load_points, thin
from tdf_jax.query import box_query, gaussian_query, gripper_query, lattice_query, snapped_query
from tdf_jax.recognition import recognition, surface_logit
from tdf_jax.refinement import refine
from tdf_jax.route import lowest_cost_path
from tdf_jax.shapes import (
    BottleParameters,
    BowlParameters,
    MugParameters,
    build_bottle,
    build_bowl,
    build_mug,
    sample_bottle,
    sample_bowl,
    sample_mug,
)
from tdf_jax.solve import SolveConfig, solve
from tdf_jax.sweep import energy_landscape
from tdf_jax.trajectory import Trajectory, displace, load_trajectory, resample, save_trajectory

__version__ = "0.1.0"
__all__ = [name for name in dir() if not name.startswith("_")]
