"""What a picture of an imitation needs, and its file: demonstration, clouds, meshes and every candidate."""

import dataclasses
import json
import os
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from tdf_jax._internal import checks
from tdf_jax._internal.boundary import public
from tdf_jax._internal.errors import InputError
from tdf_jax._internal.files import replace_file
from tdf_jax.geometry.demonstration import Demonstration
from tdf_jax.geometry.target import Target
from tdf_jax.geometry.trajectory import Trajectory
from tdf_jax.io.content import known_suffix
from tdf_jax.networks.model import Model, fingerprint
from tdf_jax.solvers.result import Result

if TYPE_CHECKING:
    import trimesh

SCENE = "scene.npz"
SCHEMA = 1  # raised when an array changes its meaning or goes
FRAME, UNIT = "world", "metre"
TARGET_ARRAYS = ("target_points", "target_query", "T_world_contact")
INDICES = ("grasp", "release")
MESHES = ("demonstrated", "object")


@dataclasses.dataclass(frozen=True)
class Weights:
    """Which weights an imitation was made with.

    Attributes:
        name: name of shipped weights, or their file.
        fingerprint: digest of the weights and the sizes of the network.
    """

    name: str
    fingerprint: str


@dataclasses.dataclass(frozen=True, eq=False)
class ImitationScene:
    """An imitation with all that a picture of it needs.

    Attributes:
        demonstration: the demonstration.
        points: cloud of the new object, (points, 3), metres, world frame.
        result: the result, with every candidate.
        target_points: cloud of the new target, (points, 3), metres, world frame; None if there is none.
        expected: ground truth, T_world_query; None where it is not known.
        meshes: meshes of the demonstrated and of the new object, metres, world frame; None where there is none.
        weights: weights of the objects; None if unknown.
        target_weights: weights of the targets; None if there are none, or if they are unknown.

    Raises:
        InputError: a cloud is no point cloud, or the result is a batch.
    """

    demonstration: Demonstration
    points: Float[np.ndarray, "points 3"]
    result: Result
    target_points: Float[np.ndarray, "target_points 3"] | None = None
    expected: Trajectory | None = None
    meshes: "tuple[trimesh.Trimesh | None, trimesh.Trimesh | None]" = (None, None)
    weights: Weights | None = None
    target_weights: Weights | None = None

    @public
    def __post_init__(self):
        object.__setattr__(self, "points", np.asarray(checks.points("ImitationScene()", self.points)))
        if self.target_points is not None:
            target_points = checks.points("ImitationScene()", self.target_points, "target_points")
            object.__setattr__(self, "target_points", np.asarray(target_points))
        shape = np.shape(self.result.trajectories)
        if len(shape) != 3:
            raise InputError(
                f"ImitationScene(): the result's trajectories have shape {shape}; expected (candidates, poses, 7) of "
                "one result. Take one of a batch with jax.tree.map(lambda x: x[i], result)"
            )


def weights_of(name: str, model: Model) -> Weights:
    """Name and fingerprint of a network.

    Args:
        name: name of shipped weights, or their file.
        model: the network.
    """
    return Weights(name, fingerprint(model))


@public
def save_imitation(path: str | os.PathLike, scene: ImitationScene) -> None:
    """Write an imitation with all that a picture of it needs.

    Args:
        path: .npz file in an existing folder; `tdf imitate` names it scene.npz.
        scene: the imitation.

    Raises:
        InputError: the suffix is not .npz, or the file cannot be written.
    """
    path = known_suffix("save_imitation()", path, (".npz",))
    demonstration, target = scene.demonstration, scene.demonstration.target
    arrays = {
        "demonstration_points": demonstration.points,
        "demonstration_wxyz_xyz": demonstration.trajectory.wxyz_xyz,
        "query": demonstration.query,
        "points": scene.points,
        **{f"demonstration_{name}": np.int64(getattr(demonstration, name)) for name in INDICES},
        **{f"result_{field.name}": getattr(scene.result, field.name) for field in dataclasses.fields(Result)},
    }
    if target is not None:
        values = (target.points, target.query, target.T_world_contact)
        arrays |= {f"demonstration_{name}": value for name, value in zip(TARGET_ARRAYS, values, strict=True)}
    if scene.target_points is not None:
        arrays["target_points"] = scene.target_points
    if scene.expected is not None:
        arrays["expected_wxyz_xyz"] = scene.expected.wxyz_xyz
    for name, mesh in zip(MESHES, scene.meshes, strict=True):
        if mesh is not None:
            arrays[f"{name}_vertices"] = np.asarray(mesh.vertices, np.float32)
            arrays[f"{name}_faces"] = np.asarray(mesh.faces, np.int32)
    header = {
        "schema": SCHEMA,
        "frame": FRAME,
        "unit": UNIT,
        **{
            name: None if weights is None else dataclasses.asdict(weights)
            for name, weights in (("weights", scene.weights), ("target_weights", scene.target_weights))
        },
    }
    plain: dict[str, Any] = {name: np.asarray(value) for name, value in arrays.items()}
    text = np.array(json.dumps(header))
    replace_file("save_imitation()", path, lambda file: np.savez_compressed(file, header=text, **plain))


@public
def load_imitation(path: str | os.PathLike) -> ImitationScene:
    """Read an imitation that `tdf imitate` or `save_imitation` wrote.

    Args:
        path: folder of `tdf imitate`, or the .npz file.

    Returns:
        The imitation.

    Raises:
        InputError: the folder or the file does not exist, is of another version of tdf_jax, or is damaged.
    """
    path = _scene_file(checks.path("load_imitation()", path))
    try:
        with path.open("rb") as file, np.lib.npyio.NpzFile(file, allow_pickle=False) as archive:
            arrays = {name: archive[name] for name in archive.files}
        header = json.loads(str(arrays.pop("header")))
        schema = header["schema"]
    except Exception as error:  # damaged archives raise errors of many kinds
        raise InputError(
            f"load_imitation(): cannot read {path} ({type(error).__name__}: {str(error)[:200]}); expected a scene of "
            "`tdf imitate`: run it again"
        ) from None
    if schema != SCHEMA:
        raise InputError(
            f"load_imitation(): {path} has schema {schema}; expected {SCHEMA}. Use the tdf_jax that wrote it, or run "
            "`tdf imitate` again"
        )
    for name, expected in (("frame", FRAME), ("unit", UNIT)):
        if header.get(name) != expected:
            raise InputError(
                f"load_imitation(): {path} has the {name} {header.get(name)!r}; expected {expected!r}: run "
                "`tdf imitate` again"
            )
    try:
        return _scene(arrays, header)
    except KeyError as error:
        raise InputError(
            f"load_imitation(): {path} has no array {error.args[0]}; expected all of a scene: run `tdf imitate` again"
        ) from None
    except InputError as error:
        raise InputError(f"load_imitation(): {path}: {error}") from None


def _scene_file(path: Path) -> Path:
    """The file of a scene, which may be named by its folder."""
    if not path.is_dir():
        if not path.exists() and path.suffix != ".npz":
            raise InputError(f"load_imitation(): there is no folder {path}; expected one that `tdf imitate` wrote")
        checks.existing_file("load_imitation()", known_suffix("load_imitation()", path, (".npz",)))
        return path
    if (path / SCENE).is_file():
        return path / SCENE
    names = sorted(entry.name for entry in path.iterdir())
    if "result.json" in names:
        why = f"it has a result.json, but no {SCENE}: another command wrote it, or an older tdf_jax"
    else:
        why = f"it has no {SCENE}, but {', '.join(names[:3])}" if names else "it is empty"
    raise InputError(
        f"load_imitation(): {path} is no folder of `tdf imitate` ({why}); expected one: run `tdf imitate` again"
    )


def _scene(arrays: Mapping[str, np.ndarray], header: Mapping[str, Any]) -> ImitationScene:
    target = None
    if f"demonstration_{TARGET_ARRAYS[0]}" in arrays:
        target = Target(*(arrays[f"demonstration_{name}"] for name in TARGET_ARRAYS))
    demonstration = Demonstration(
        arrays["demonstration_points"],
        Trajectory(jnp.asarray(arrays["demonstration_wxyz_xyz"])),
        arrays["query"],
        int(arrays["demonstration_grasp"]),
        int(arrays["demonstration_release"]),
        target,
    )
    # A field that a former tdf_jax did not know has its default, which says unknown.
    required = [field.name for field in dataclasses.fields(Result) if field.default_factory is dataclasses.MISSING]
    names = [field.name for field in dataclasses.fields(Result)]
    fields: dict[str, Any] = {
        name: arrays[f"result_{name}"] for name in names if name in required or f"result_{name}" in arrays
    }
    fields |= {name: int(fields[name]) for name in INDICES}
    expected = arrays.get("expected_wxyz_xyz")
    known = {name: header[name] and Weights(**header[name]) for name in ("weights", "target_weights")}
    return ImitationScene(
        demonstration,
        arrays["points"],
        Result(**fields),
        arrays.get("target_points"),
        None if expected is None else Trajectory(jnp.asarray(expected)),
        (_mesh(arrays, MESHES[0]), _mesh(arrays, MESHES[1])),
        **known,
    )


def _mesh(arrays: Mapping[str, np.ndarray], name: str) -> "trimesh.Trimesh | None":
    if f"{name}_vertices" not in arrays:
        return None
    import trimesh

    return trimesh.Trimesh(arrays[f"{name}_vertices"], arrays[f"{name}_faces"], process=False)
