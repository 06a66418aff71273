"""Depth images of `tdf imitate --depth`: their files, and the object that they show."""

import dataclasses
import json
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from tdf_jax._internal import checks
from tdf_jax._internal.errors import InputError
from tdf_jax.cli.options import Settings
from tdf_jax.geometry.demonstration import Demonstration
from tdf_jax.io.content import reading
from tdf_jax.networks.model import Model
from tdf_jax.perception.choice import pick_object
from tdf_jax.perception.clusters import separate_objects, workspace_box
from tdf_jax.perception.depth import points_from_depth
from tdf_jax.solvers.pick import CarryConfig

COMMAND = "tdf imitate"
IMAGES = (".png", ".tif", ".tiff", ".npy")


@dataclasses.dataclass(frozen=True, eq=False)
class Seen:
    """What depth images show.

    Attributes:
        clouds: cloud of each object, (points, 3), metres; one where masks say which pixels are the object's.
        pixels: for each image, its file and what became of its pixels.
        world: whether the poses of the cameras are given; otherwise the frame is that of the camera.
    """

    clouds: list[Float[np.ndarray, "_ 3"]]
    pixels: list[dict[str, Any]]
    world: bool


def read_scene(settings: Settings) -> Seen | None:
    """Read the depth images of a command, and separate the objects that they show.

    Args:
        settings: settings from `resolved`.

    Returns:
        The objects; None without depth images.

    Raises:
        InputError: a file that cannot be used, or options that contradict each other.
    """
    if settings.depth is None:
        return None
    count = len(settings.depth)
    intrinsics = _intrinsics(settings, count)
    poses = _for_each("--camera-pose", settings.camera_pose, count)
    masks = _for_each("--mask", settings.mask, count)
    if count > 1 and poses[0] is None:
        raise InputError(
            f"{COMMAND}: there are {count} depth images without poses; expected --camera-pose FILE ..., one for each, "
            "so that their points can be merged in one world frame"
        )
    if masks[0] is not None and settings.clusters:
        raise InputError(f"{COMMAND}: --mask says what the object is, and --clusters finds objects; drop one")
    scale = 1.0 if settings.depth_scale is None else settings.depth_scale
    views, pixels, cameras = [], [], []
    for path, matrix, pose, mask in zip(settings.depth, intrinsics, poses, masks):
        T = None if pose is None else _numbers("--camera-pose", pose)
        T = T.reshape(4, 4) if T is not None and T.size == 16 else T
        shown = None if mask is None else _image("--mask", mask)
        try:
            points, counts = points_from_depth(_image("--depth", path), matrix, T, shown, scale, return_counts=True)
        except InputError as error:
            message = str(error).removeprefix("points_from_depth(): ").replace("depth_scale=", "--depth-scale ")
            raise InputError(f"{COMMAND}: {path}: {message}") from None
        views.append(points)
        pixels.append({"file": str(path), **counts._asdict()})
        cameras.append(np.zeros(3) if T is None else T[:3, 3])
    if masks[0] is None:
        clouds = separate_objects(views, settings.workspace, camera=cameras)
    else:
        clouds = [cloud := np.concatenate(views)]
        if settings.workspace is not None:
            low, high = workspace_box(COMMAND, settings.workspace)
            clouds = [cloud[((cloud >= low) & (cloud <= high)).all(axis=1)]]
            if not len(clouds[0]):
                raise InputError(f"{COMMAND}: no point of the mask is in --workspace; expected some. Check its frame")
    return Seen(clouds, pixels, poses[0] is not None)


def choose(
    settings: Settings,
    seen: Seen,
    model: Model,
    target_model: Model | None,
    demonstration: Demonstration,
    config: CarryConfig,
) -> tuple[np.ndarray, np.ndarray | None, dict]:
    """Choose the object among what depth images show, and the target if the demonstration has one.

    With a mask, or with a file of the target, only the object is chosen.

    Args:
        settings: settings of the command.
        seen: the objects.
        model: network of the object.
        target_model: network of the target; None for `model`.
        demonstration: the demonstration.
        config: settings of the searches.

    Returns:
        Cloud of the object; cloud of the target, None where it was not chosen; and the record of both.
    """
    related = demonstration.target is not None and settings.target_object is None and settings.mask is None
    asked = demonstration if related else dataclasses.replace(demonstration, target=None)
    _, choice = pick_object(
        model,
        seen.clouds,
        asked,
        target_model=target_model if related else None,
        config=config,
        return_choice=True,
    )
    target = None if choice.target is None else _sampled(seen.clouds[choice.target], settings)
    clusters = []
    for index, cloud in enumerate(seen.clouds):
        taken = {choice.object: "object", choice.target: "target"}.get(index)
        residuals = choice.residuals[index], choice.target_residuals[index]
        clusters.append(
            {
                "points": len(cloud),
                "centre": cloud.mean(axis=0).tolist(),
                "size": np.ptp(cloud, axis=0).tolist(),
                "residual": float(residuals[0]),
                "target_residual": float(residuals[1]) if np.isfinite(residuals[1]) else None,
                "taken": taken,
            }
        )
    record = {"frame": "world" if seen.world else "camera", "images": seen.pixels, "clusters": clusters}
    return _sampled(seen.clouds[choice.object], settings), target, record


def table(camera: dict) -> str:
    """What was found and what was taken, in a line for each cluster.

    Args:
        camera: record from `choose`.
    """
    lines = [f"{'cluster':<9}{'points':>7}  {'centre, m':<24}{'size, cm':<20}{'residual':>8}  taken"]
    for number, one in enumerate(camera["clusters"], 1):
        centre = " ".join(f"{x:.3f}" for x in one["centre"])
        size = " x ".join(f"{100 * x:.1f}" for x in one["size"])
        residual = f"{one['residual']:.2f}" + (
            "" if one["target_residual"] is None else f", as the target {one['target_residual']:.2f}"
        )
        lines.append(f"{number:<9}{one['points']:>7}  {centre:<24}{size:<20}{residual:>8}  {one['taken'] or '-'}")
    return "\n".join(lines)


def _sampled(points: np.ndarray, settings: Settings) -> np.ndarray:
    """At most as many points as of a file, drawn in the same way."""
    if len(points) <= settings.points:
        return points
    rng = np.random.default_rng(settings.seed)
    return points[np.sort(rng.choice(len(points), settings.points, replace=False))]


def _for_each(option: str, paths: tuple[Path, ...] | None, count: int) -> list[Path | None]:
    if paths is None:
        return [None] * count
    if len(paths) != count:
        raise InputError(
            f"{COMMAND}: {option} has {len(paths)} files and --depth {count}; expected one for each depth image, in "
            "the same order"
        )
    return list(paths)


def _intrinsics(settings: Settings, count: int) -> list[np.ndarray]:
    """Intrinsics of every image: four numbers, or a file for all or for each."""
    words = settings.intrinsics
    if words is None:
        raise InputError(f"{COMMAND}: --depth needs --intrinsics FX FY CX CY, or --intrinsics FILE; give one")
    try:
        numbers = np.array([float(word) for word in words])
    except ValueError:
        files = [Path(word) for word in words]
        if len(files) not in (1, count):
            raise InputError(
                f"{COMMAND}: --intrinsics has {len(files)} files and --depth {count}; expected one for all, or one for "
                "each"
            ) from None
        return [_camera_file(file) for file in files] * (count if len(files) == 1 else 1)
    if len(numbers) not in (4, 9):
        raise InputError(
            f"{COMMAND}: --intrinsics has {len(numbers)} numbers; expected FX FY CX CY, or the nine of a matrix"
        )
    return [numbers if len(numbers) == 4 else numbers.reshape(3, 3)] * count


def _camera_file(path: Path) -> np.ndarray:
    """Intrinsics in a file: an array, text, or JSON of librealsense, ROS or Open3D."""
    if path.suffix.lower() != ".json":
        values = _numbers("--intrinsics", path)
        return values.reshape(3, 3) if values.size == 9 else values
    path = checks.existing_file(COMMAND, path)
    with reading(COMMAND, path):
        known = json.loads(path.read_bytes())
        if "intrinsic_matrix" in known:  # Open3D writes the columns one after the other
            return np.array(known["intrinsic_matrix"], float).reshape(3, 3).T
        for name in ("K", "k", "camera_matrix"):
            if name in known:
                values = known[name]["data"] if isinstance(known[name], dict) else known[name]
                return np.array(values, float).reshape(3, 3)
        lower = {str(name).lower(): value for name, value in known.items()}
        names = ("fx", "fy", "ppx" if "ppx" in lower else "cx", "ppy" if "ppy" in lower else "cy")
        if all(name in lower for name in names):
            return np.array([float(lower[name]) for name in names])
    raise InputError(
        f"{COMMAND}: {path} has no intrinsics by a known name; expected fx, fy, cx (or ppx), cy (or ppy), K, or "
        "intrinsic_matrix"
    )


def _numbers(option: str, path: Path) -> np.ndarray:
    """Numbers of an array or a text file."""
    path = checks.existing_file(COMMAND, path, f"a file of {option}; check the path")
    with reading(COMMAND, path):
        if path.suffix.lower() == ".npy":
            return np.asarray(np.load(path, allow_pickle=False), float)
        return np.array(path.read_text().replace(",", " ").split(), float)


def _image(option: str, path: Path) -> np.ndarray:
    """Pixels of an image."""
    path = checks.existing_file(COMMAND, path, f"a file of {option}; check the path")
    if path.suffix.lower() not in IMAGES:
        raise InputError(
            f"{COMMAND}: {option} {path} is no {', '.join(IMAGES)}; expected one of these. JPEG changes depths"
        )
    with reading(COMMAND, path):
        if path.suffix.lower() == ".npy":
            return np.load(path, allow_pickle=False)
        try:
            from PIL import Image
        except ImportError:
            raise InputError(f"{COMMAND}: {path} needs Pillow; pip install pillow, or save it as .npy") from None
        with Image.open(path) as image:
            return np.asarray(image)
