"""Options of `tdf imitate` and `tdf landscape`."""

import dataclasses
from pathlib import Path
from typing import Annotated, ClassVar, Literal, TypeVar, cast

import tyro

from tdf_jax._internal import checks
from tdf_jax._internal.errors import InputError
from tdf_jax.evaluation.relation_tasks import RELATIONS
from tdf_jax.landscape.shortest_path import SHARPEST
from tdf_jax.networks.checkpoint import available_models
from tdf_jax.shapes import FAMILIES

Category = Literal["mug", "bowl", "bottle", "rack", "container"]
MULTI = ("mug", "bowl", "bottle")  # categories that the shipped weights `multi` were trained on
DEPTH_OPTIONS = ("intrinsics", "camera_pose", "mask", "workspace", "depth_scale", "clusters")  # that need --depth
# Options that make or read another object or demonstration than that of a task.
CONTRADICT_TASK = ("depth", "demonstration", "target_object", "category", "trajectory", "num_poses", "queries")


def _option(metavar: str | None = None, default: str | None = None):
    """The words of the help for a value, and for a default that depends on other options."""
    return tyro.conf.arg(metavar=metavar, help_behavior_hint=None if default is None else f"(default: {default})")


@dataclasses.dataclass(frozen=True)
class SceneSettings:
    """A demonstration and a new object, from files or generated.

    Attributes:
        target: mesh or point cloud of the new object; the second object is --target-object.
        scale: metres per unit of the target file, such as 0.01 for centimetres.
        drop_invalid: remove points of the target file that are NaN or stand for missing measurements.
        target_pose: pose of the target in the world: that of its file, or a random rotation and translation of it.
        demonstration: .npz file of `tdf demonstrate` or `tdf view --demonstrate`, or with the arrays points, wxyz_xyz
            and query, in metres.
        category: category of generated objects.
        trajectory: shape of a generated demonstration, from the category's first place, such as a mug's handle,
            to a place 0.30 m away; lift_over ends on a shelf there.
        num_poses: number of poses from the grasp to the release; a demonstration file is resampled to another number.
        queries: number of query points of a generated demonstration.
        points: number of points that are sampled from a mesh or a larger cloud.
        seed: seed of all random numbers.
        weights: a name of shipped weights, or a .safetensors file.
    """

    target: Annotated[Path | None, _option("FILE", "a generated object")] = None
    scale: float = 1.0
    drop_invalid: bool = False
    target_pose: Annotated[
        Literal["given", "random"] | None, _option(default="given for a file, random for a generated object")
    ] = None
    demonstration: Annotated[Path | None, _option("FILE", "one on another generated object")] = None
    category: Annotated[Category | None, _option(default="that of shipped weights; mug")] = None
    trajectory: Annotated[
        Literal["line", "semicircle", "wave", "lift_over", "tilt_and_pour", "hang_on_rack"] | None,
        _option(default="wave of a mug, lift_over of others"),
    ] = None
    num_poses: Annotated[int | None, _option("INT", "7, or those of the demonstration file")] = None
    queries: Annotated[int | None, _option("INT", "128")] = None
    points: int = 1500
    seed: int = 0
    weights: Annotated[str | None, _option("NAME|FILE", "those of the category")] = None

    COMMAND: ClassVar[str] = "tdf"


@dataclasses.dataclass(frozen=True)
class Settings(SceneSettings):
    """The demonstration, the target and the method of an imitation.

    Attributes:
        target: mesh or point cloud of the new object; the second object is --target-object. With --task, whether the
            second object is found anew, or known, because it stands where it stood in the demonstration.
        target_pose: pose of the target in the world: that of its file, or a random rotation and translation of it. With
            --task, given is upright with a random yaw.
        task: place a generated object on a generated target, both from one seed, as demonstrated on another such pair.
        targets: folder of meshes and point clouds, instead of --target; --out gets a folder of results for each of
            them, named as its file. Run again, the command does what is missing.
        depth: depth images of the new object instead of --target: 16-bit .png or .tif with --depth-scale, or .npy in
            metres. Without --mask, the table is removed and the demonstration's object is chosen among the others.
        intrinsics: focal lengths and principal point of the camera, pixels; or a file with them or with the matrix K
            (.txt, .npy, .json), or one for each image.
        camera_pose: file of the camera's pose T_world_camera for each image, 4x4, metres (.txt, .npy); x to the right
            of the image, y down, z forward. Without it the camera's frame is the world.
        mask: image of the object's pixels for each depth image; then nothing is removed but pixels at edges.
        workspace: box that the objects are in, metres, world frame.
        depth_scale: metres per unit of the depth images, such as 0.001 for millimetres.
        clusters: say which objects the depth images show, and which was taken.
        clean: remove foreign points, such as of the table, from the clouds of the object and the target.
        goal_offset: translation that is added to the goal, metres, world frame.
        target_object: mesh or point cloud of the object that the new one is placed on or in, in the unit of --target;
            the demonstration file must have one too. Without it the demonstrated one has not moved.
        target_weights: a name of shipped weights, or a .safetensors file, for --target-object or the target of --task.
        k: weight of the correlation term of eq. 3, for the methods that minimise it; the paper's best is 0.02.
        method: carry the demonstration from the pick to the goal; or minimise the paper's energy, eq. 3, by damped
            Gauss-Newton, or by Adam as in the paper.
        num_starts: number of random starts.
        iterations: number of Adam's steps.
        out: folder of the results; an earlier result there is replaced.
        no_plots: write no imitation.png and loss.png.
        animation: film of the imitation, a .gif or .mp4 file.
        page: write imitation.html, to turn and play in a browser without a network; needs the extra "pages".
        json: print result.json instead of the table.
    """

    target: Annotated[Path | None, _option("FILE|known|found", "a generated object; found with --task")] = None
    targets: Annotated[Path | None, _option("DIR", "none")] = None
    task: Annotated[Literal["bowl_on_mug", "mug_on_rack", "bottle_in_container"] | None, _option(default="none")] = None
    depth: Annotated[tuple[Path, ...] | None, _option("FILE ...", "none")] = None
    intrinsics: Annotated[tuple[str, ...] | None, _option("FX FY CX CY|FILE ...", "none")] = None
    camera_pose: Annotated[tuple[Path, ...] | None, _option("FILE ...", "the identity")] = None
    mask: Annotated[tuple[Path, ...] | None, _option("FILE ...", "none")] = None
    workspace: Annotated[
        tuple[float, float, float, float, float, float] | None, _option("XMIN YMIN ZMIN XMAX YMAX ZMAX", "everywhere")
    ] = None
    depth_scale: Annotated[float | None, _option("FLOAT", "1; whole numbers need it")] = None
    clusters: bool = False
    clean: bool = True
    goal_offset: Annotated[tuple[float, float, float], _option("X Y Z")] = (0.0, 0.0, 0.0)
    target_object: Annotated[Path | None, _option("FILE", "none")] = None
    target_weights: Annotated[str | None, _option("NAME|FILE", "those of --weights, or of the category")] = None
    k: Annotated[float | None, _option("FLOAT", "0.02")] = None
    method: Literal["carry", "gauss-newton", "adam"] = "carry"
    num_starts: Annotated[int | None, _option("INT", "64 of the pick; 10 of other methods")] = None
    iterations: Annotated[int | None, _option("INT", "100")] = None
    out: Annotated[Path, _option("DIR")] = Path("imitation")
    no_plots: bool = False
    animation: Annotated[Path | None, _option("FILE", "none")] = None
    page: bool = False
    json: bool = False

    COMMAND: ClassVar[str] = "tdf imitate"


@dataclasses.dataclass(frozen=True)
class LandscapeSettings(SceneSettings):
    """The grid, the query points and the orientations of a landscape.

    Attributes:
        target_pose: pose of the target in the world: that of its file, or a random rotation and translation of it.
        grid: a plane through the middle of the demonstrated path, a volume about it, or the neighbourhood of the path;
            its axes are those of the orientation, or of the world if there are many orientations.
        half: half of the edge of the plane or the volume, metres.
        radius: radius of the neighbourhood of a path, metres.
        pitch: distance of neighbouring grid points, metres; the edge is rounded to a multiple of it.
        query: query points: a lattice of the grid's pitch in the box of the demonstration's query points, those points
            moved onto the lattice, or those points unchanged. Unchanged points take far longer in one orientation;
            with many orientations, a lattice saves nothing.
        rotation: orientation of the query frame: that of the pick in the demonstration, the axes of the world (as in
            the paper), the best of many at every point, or the best of rotations of the pick about an axis.
        rotations: number of orientations for "best" and "turns".
        axis: axis of "turns", world frame.
        reduce: how the waypoints' energies are combined: the minimum, a soft minimum, each in its ring about the pick,
            or the mean.
        sharpness: exponent of the energy in the cost of the lowest-cost path from the pick to the goal.
        out: folder of the results; an earlier result there is replaced.
        no_plots: write no pictures.
        page: write landscape.html, to turn in a browser without a network; needs the extra "pages".
        json: print result.json instead of the table.
    """

    target_pose: Annotated[Literal["given", "random"] | None, _option(default="given")] = None
    grid: Literal["xy", "xz", "yz", "volume", "path"] = "yz"
    half: float = 0.3
    radius: float = 0.1
    pitch: float = 0.012
    query: Annotated[
        Literal["lattice", "snapped", "given"] | None, _option(default="lattice; given for many orientations")
    ] = None
    rotation: Literal["pick", "identity", "best", "turns"] = "pick"
    rotations: int = 24
    axis: Annotated[tuple[float, float, float], _option("X Y Z")] = (0.0, 0.0, 1.0)
    reduce: Literal["min", "softmin", "assigned", "mean"] = "min"
    sharpness: float = 1.0
    out: Annotated[Path, _option("DIR")] = Path("landscape")
    no_plots: bool = False
    page: bool = False
    json: bool = False

    COMMAND: ClassVar[str] = "tdf landscape"


def categories_of(weights: str | None) -> tuple[str, ...]:
    """Categories of shipped weights; mugs for other files."""
    if weights == "multi":
        return MULTI
    return (weights,) if weights in FAMILIES else ("mug",)


AnySettings = TypeVar("AnySettings", bound=SceneSettings)


def resolved(settings: AnySettings) -> AnySettings:
    """Fill in the defaults that depend on other options.

    Args:
        settings: settings of a command.

    Raises:
        InputError: a bad number, or options that contradict each other.
    """
    if isinstance(settings, Settings) and settings.task is not None:
        return cast(AnySettings, _resolved_task(settings))
    _check_numbers(settings)
    category = settings.category or categories_of(settings.weights)[0]
    settings = dataclasses.replace(settings, category=category, weights=settings.weights or category)
    generated = "random"
    if isinstance(settings, LandscapeSettings):
        generated = "given"
        one = settings.rotation in ("pick", "identity")
        query = settings.query or ("lattice" if one else "given")
        settings = cast(AnySettings, dataclasses.replace(settings, query=query))
    seen = isinstance(settings, Settings) and settings.depth is not None
    pose = settings.target_pose or (generated if settings.target is None and not seen else "given")
    if settings.demonstration is None:
        return dataclasses.replace(
            settings,
            target_pose=pose,
            trajectory=settings.trajectory or ("wave" if category == "mug" else "lift_over"),
            num_poses=7 if settings.num_poses is None else settings.num_poses,
            queries=128 if settings.queries is None else settings.queries,
        )
    for name in ("trajectory", "queries"):
        if getattr(settings, name) is not None:
            raise InputError(
                f"{settings.COMMAND}: --{name} is for a generated demonstration, and there is a file; drop one"
            )
    return dataclasses.replace(settings, target_pose=pose)


def _resolved_task(settings: Settings) -> Settings:
    """The settings of a task; its own demonstration contradicts others."""
    task = cast(str, settings.task)
    known = str(settings.target) == "known"
    if settings.target is not None and str(settings.target) not in ("known", "found"):
        raise InputError(
            f"tdf imitate: --target is {settings.target} and --task is {task}; expected --target known or found; a "
            "file needs a --demonstration instead of --task"
        )
    for name in CONTRADICT_TASK:
        value = getattr(settings, name)
        if value is not None:
            option = "--" + name.replace("_", "-")
            raise InputError(
                f"tdf imitate: {option} is {value} and --task is {task}; expected one of the two, because a task "
                "generates its objects and its demonstration; drop one"
            )
    if settings.method != "carry":
        raise InputError(
            f"tdf imitate: --method is {settings.method} and --task is {task}; expected carry, which alone finds a "
            "goal on a target; drop one"
        )
    for name, given in (("scale", settings.scale != 1), ("drop-invalid", settings.drop_invalid)):
        if given:
            raise InputError(
                f"tdf imitate: --{name} is for a file and --task is {task}; expected one of the two, because a task "
                "generates its objects; drop one"
            )
    if any(settings.goal_offset):
        raise InputError(
            f"tdf imitate: --goal-offset is {settings.goal_offset} and --task is {task}; expected none, because the "
            "goal is found on the target; drop one"
        )
    # A word, and not a file.
    _check_numbers(dataclasses.replace(settings, target=None, target_weights=None))
    relation = RELATIONS[task]
    return dataclasses.replace(
        settings,
        target=Path("known" if known else "found"),
        category=cast(Category, relation.object),
        weights=settings.weights or _shipped(task, relation.object, "--weights"),
        target_weights=settings.target_weights or _target_weights(task, relation.target, known),
        target_pose=settings.target_pose or "random",
    )


def _target_weights(task: str, category: str, known: bool) -> str | None:
    """Weights of a task's target. One that has not moved needs none; with some, both shapes seat the object."""
    return None if known and category not in available_models() else _shipped(task, category, "--target-weights")


def _shipped(task: str, category: str, option: str) -> str:
    """The name of a category's shipped weights, if there are any."""
    names = available_models()
    if category not in names:
        raise InputError(
            f"tdf imitate: --task {task} needs weights of a {category}, and none are shipped (shipped are "
            f"{', '.join(names)}); give {option} FILE, from tdf train"
        )
    return category


def _check_numbers(settings: SceneSettings) -> None:
    checks.seed(settings.COMMAND, settings.seed, "--seed")
    for name, given in (("scale", settings.scale != 1), ("drop-invalid", settings.drop_invalid)):
        if settings.target is None and given:
            raise InputError(f"{settings.COMMAND}: --{name} is for a --target file; give one, or drop --{name}")
    if isinstance(settings, Settings):
        _check_depth(settings)
        if settings.k is not None and settings.method == "carry":
            raise InputError(
                "tdf imitate: --k is a weight of eq. 3, which --method carry does not minimise; drop it, or add "
                "--method gauss-newton or adam"
            )
        if settings.num_starts is not None:
            checks.count("tdf imitate", "--num-starts", settings.num_starts)
        if settings.k is not None:
            checks.number("tdf imitate", "--k", settings.k, 0)
        checks.vector("tdf imitate", "--goal-offset", settings.goal_offset)
        if settings.target_object is not None and settings.demonstration is None:
            raise InputError(
                "tdf imitate: --target-object needs a --demonstration with a target; give one, see tdf demonstrate"
            )
        if settings.target_weights is not None and settings.demonstration is None:
            raise InputError(
                "tdf imitate: --target-weights is for a --demonstration with a target or a --task; give one, or drop it"
            )
    if isinstance(settings, LandscapeSettings):
        for name in ("half", "radius", "pitch"):
            checks.positive("tdf landscape", f"--{name}", getattr(settings, name), "metres")
        if settings.grid != "path" and settings.half < settings.pitch / 2:
            raise InputError(
                f"tdf landscape: --half is {settings.half}; expected at least half the pitch of {settings.pitch}: two "
                "points a side"
            )
        checks.number("tdf landscape", "--sharpness", settings.sharpness, 0, SHARPEST)
        if settings.grid == "path" and settings.pitch > settings.radius:
            raise InputError(
                f"tdf landscape: --pitch is {settings.pitch} and --radius {settings.radius}; expected a pitch of "
                "at most the radius"
            )
        checks.count("tdf landscape", "--rotations", settings.rotations)


def _check_depth(settings: Settings) -> None:
    """Options of depth images that contradict others."""
    if settings.depth is None:
        for name in DEPTH_OPTIONS:
            if getattr(settings, name) not in (None, False):
                option = "--" + name.replace("_", "-")
                raise InputError(f"tdf imitate: {option} is for --depth images; give some, or drop {option}")
        return
    if not settings.depth:
        raise InputError("tdf imitate: --depth has no file; expected at least one depth image")
    for name, given in (("target", settings.target), ("target-pose random", settings.target_pose == "random")):
        if given:
            raise InputError(f"tdf imitate: --{name} is for another object than that of --depth; drop one")
