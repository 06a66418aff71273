"""Cases of arguments: each public function with one argument that is hostile, and the others as they should be."""

import dataclasses
from collections.abc import Callable
from typing import Any

import numpy as np

from . import damage, undamaged as good
from .cases import ANY, ONLY_REFUSED, ONLY_RIGHT, Case, differs
from .files import not_finite, one_of
from .undamaged import CLOUD, World, leaves


@dataclasses.dataclass(frozen=True)
class Call:
    """A function and arguments that it takes.

    Attributes:
        function: the function.
        arguments: its arguments by name.
        optional: names of arguments that may be None.
        shapes: names of arrays that may have other numbers of rows or axes.
    """

    function: Callable
    arguments: dict[str, Any]
    optional: tuple[str, ...] = ()
    shapes: tuple[str, ...] = ()


def calls(world: World) -> dict[str, Callable[[], Call]]:
    """Every public function that is tried, by name."""
    import jax

    tdf = world.tdf
    trajectory = tdf.Trajectory(good.poses())
    key, query, pose = jax.random.key(0), good.query(), good.poses()[0]
    ends = {"num_poses": 4, "start": [0.3, -0.2, 0.1], "end": [0.3, 0.1, 0.1], "rotation": np.eye(3)}
    curved = ends | {"end_rotation": np.diag([1.0, -1, -1])}
    box = tdf.box_obstacle([0.3, 0, 0.1], [0.1, 0.1, 0.1])
    residuals = {"residual": 0.003}
    table = {
        "line": (curved, ("rotation", "end_rotation")),
        "semicircle": (curved | {"height": 0.1, "bulge": [0.0, 0, 1]}, ("height", "rotation", "end_rotation")),
        "wave": (curved | {"height": 0.1, "bulge": [0.0, 0, 1]}, ("height", "rotation", "end_rotation")),
        "lift_over": (curved | {"height": 0.15, "up": [0, 0, 1.0]}, ("rotation", "end_rotation")),
        "tilt_and_pour": (ends | {"height": 0.1, "tilt": 1.0, "up": [0, 0, 1.0]}, ("rotation",)),
        "hang_on_rack": (curved | {"approach": [0, 0.1, 0]}, ("rotation", "end_rotation")),
        "box_query": ({"key": key, "count": 8, "size": [0.05, 0.04, 0.03], "centre": [0.01, 0, 0]}, ()),
        "gaussian_query": ({"key": key, "count": 8, "sigma": 0.025, "centre": [0.01, 0, 0]}, ()),
        "gripper_query": ({"key": key, "count": 8, "opening": 0.08, "finger": [0.02, 0.01, 0.045], "palm": 0.03}, ()),
        "lattice_query": ({"shape": [3, 2, 2], "pitch": 0.01, "centre": [0.01, 0, 0]}, ()),
        "snapped_query": ({"query": query, "pitch": 0.01, "centre": [0.01, 0, 0]}, ()),
        "turns": ({"axis": [0, 0, 1.0], "count": 4, "start": np.eye(3)}, ("start",)),
        "rotation_grid": ({"count": 5}, ()),
        "plane_grid": ({"half": 0.1, "count": 5, "origin": [0.3, 0, 0], "axes": "xy"}, ()),
        "volume_grid": ({"half": 0.1, "count": 4, "origin": [0.3, 0, 0], "axes": np.eye(3)}, ("axes",)),
        "path_grid": ({"path": trajectory, "radius": 0.05, "step": 0.02, "axes": np.eye(3)}, ("axes",)),
        "thin": ({"points": CLOUD, "count": 10}, ()),
        "drop_invalid": ({"points": CLOUD}, ()),
        "resample": ({"trajectory": trajectory, "num_poses": 6}, ()),
        "displace": ({"trajectory": trajectory, "offset": [0.1, 0, 0], "where": "goal"}, ()),
        "carry_trajectory": ({"demonstrated": trajectory, "pick": pose, "goal": good.poses()[3]}, ("goal",)),
        "box_obstacle": ({"centre": [0.3, 0, 0], "size": [0.1, 0.1, 0.1], "rotation": np.eye(3)}, ("rotation",)),
        "cloud_obstacle": ({"points": CLOUD, "radius": 0.01, "pitch": 0.02, "pad": 0.02}, ()),
        "clearance": ({"trajectory": trajectory, "body": CLOUD, "obstacles": [box], "between": 2}, ("between",)),
        "cluster_poses": (
            {"wxyz_xyz": good.poses(), "energies": np.float32([0.1, 0.2, 0.3, 0.4]), "angle": 0.3, "distance": 0.02}, ()
        ),
        "confidence": (residuals | {"intercept": 3.0, "slope": -2.0}, ()),
        "recognition": (residuals | {"surface_logit": 1.0, "curve": [1.0, 2.0, 3.0]}, ()),
        "lowest_cost_path": (
            {"landscape": world.landscape, "start": [0.25, -0.25, 0.1], "goal": [0.35, -0.15, 0.1],
            "sharpness": 1.0}, ()
        ),
        "Trajectory.from_matrices": ({"T_world_query": np.tile(np.eye(4), (4, 1, 1))}, ()),
        "Demonstration": ({"points": CLOUD, "trajectory": trajectory, "query": query, "grasp": 0, "release": -1}, ()),
        "Grid": (
            {"origin": np.zeros(3), "directions": np.eye(3)[:2], "coordinates": (np.arange(3.0), np.arange(4.0)),
             "mask": np.ones((3, 4), bool)}, ("mask",)
        ),
        # Not its numbers: JAX fills trees of it with objects of every kind.
        "EnergyWeights": ({"pose_norm": "frobenius", "compensator_order": "infinity"}, ()),
        "CarryConfig": ({"num_starts": 8, "num_candidates": 3, "coarse_steps": 2, "start": "uniform",
        "tolerance": 0.1}, ()),
        "SolveConfig": ({"num_starts": 8, "num_candidates": 3, "refine_steps": 2, "tolerance": 0.1}, ()),
        "OptimizeConfig": ({"num_starts": 3, "iterations": 2, "rotation_rate": 0.01, "translation_rate": 0.01}, ()),
        "ClearanceConfig": ({"rotation_scale": 0.1, "deviation": 0.1, "iterations": 10}, ()),
        "NetworkConfig": (dict(good.TINY_NETWORK, neighbours=20, slope=0.2, scaling=1.0), ()),
        # Records of dimensions are checked when an object is built of them.
        "build_bowl": ({"height": 0.05, "radius": 0.08, "wall_thickness": 0.004, "curve": 2.0}, ()),
        "build_bottle": ({"height": 0.2, "radius": 0.03, "neck_radius": 0.01, "cap_height": 0.02}, ()),
    }  # fmt: skip
    builders = {
        "build_bowl": lambda **dimensions: tdf.build_bowl(tdf.BowlParameters(**dimensions)).mesh,
        "build_bottle": lambda **dimensions: tdf.build_bottle(tdf.BottleParameters(**dimensions)).mesh,
    }

    def call(name):
        arguments, optional = table[name]
        function = tdf
        for part in name.split("."):
            function = builders.get(name) or getattr(function, part)
        if name.endswith(("Config", "Weights")):
            known = {field.name for field in dataclasses.fields(function)}  # pyright: ignore
            arguments = {key: value for key, value in arguments.items() if key in known}
        return Call(function, arguments, optional)

    return {name: lambda name=name: call(name) for name in table}


# What replaces a number. Large counts are not among them: what they ask for cannot be made here.
WHOLE = (
    0,
    -1,
    -(2**40),
    2.5,
    np.nan,
    np.inf,
    "7",
    [3],
    True,
    None,
    1j,
    b"2",
    {},
    np.zeros(2),
    object(),
    np.float32(2.5),
)
REAL = (np.nan, np.inf, -np.inf, "0.1", None, [0.1, 0.2], True, 1j, np.zeros(3), {}, object(), b"1", 10**400)
WORD = ("", "nonsense", None, 3, "XY", b"goal", ["goal"], {}, object(), np.nan, "goal\0")
OTHER = (None, 0, "path", b"", [], {}, object(), np.zeros((4, 7)), np.nan, True, lambda: 0)
# Fields of plain records that are words for people: any str is one.
FREE = {"name", "source"}
# Functions whose documentation says what they make of numbers that are not finite.
UNKNOWN = {"recognition", "confidence", "cluster_poses", "drop_invalid"}


def hostile(rng, name: str, value: Any, optional: bool):
    """A hostile value, its description, and whether it must be refused (None if it may be right)."""
    if isinstance(value, bool):
        return repr(value), value, None
    if isinstance(value, int):
        chosen = one_of(rng, WHOLE)
        fine = chosen is None and optional
        zero = chosen in (0, -1) if isinstance(chosen, int) and not isinstance(chosen, bool) else False
        return f"{chosen!r:.40}", chosen, None if fine or zero else True
    if isinstance(value, float):
        chosen = one_of(rng, (*REAL, 0.0, -1.0, 1e-30, 1e30, np.float32(value), np.asarray(value)))
        odd = not isinstance(chosen, float | np.floating | np.ndarray) or np.ndim(chosen) > 0 or not np.isfinite(chosen)
        fine = chosen is None and optional
        return f"{chosen!r:.40}", chosen, True if odd and not fine else None
    if isinstance(value, str):
        chosen = one_of(rng, WORD)
        fine = name in FREE and isinstance(chosen, str)
        return f"{chosen!r:.40}", chosen, None if fine else True
    if _is_key(value):
        import jax

        chosen = one_of(rng, [None, 0, "key", np.zeros(2), jax.random.split(value), np.float32([0, 1]), [0, 0], np.nan])
        return f"{chosen!r:.40}", chosen, True
    if isinstance(value, np.ndarray) or (isinstance(value, list) and all(isinstance(x, int | float) for x in value)):
        if rng.random() < 0.3:
            return *damage.same_numbers(rng, np.asarray(value)), False
        if rng.random() < 0.15:
            factor = one_of(rng, [0.0, -1.0, 1e30, 1e-30, 1000.0])
            return f"times {factor:g}", np.asarray(value) * factor, None
        text, odd = damage.no_numbers(rng, value)
        if text == "strings":  # the same numbers, if it is read at all
            return text, odd, "same"
        loose = text in {"no rows", "one more axis", "a column less", "a column more", "two more axes"}
        return text, odd, None if loose else True
    chosen = one_of(rng, OTHER)
    return f"{chosen!r:.40}", chosen, None if chosen is None and optional else True


def _is_key(value) -> bool:
    import jax

    return isinstance(value, jax.Array) and jax.numpy.issubdtype(value.dtype, jax.dtypes.prng_key)


def argument_case(rng, world: World, folder) -> Case:
    """A public function with one hostile argument."""
    if "_calls" not in world.__dict__:
        world.__dict__["_calls"] = calls(world)
    table = world.__dict__["_calls"]
    name = one_of(rng, sorted(table))
    call = table[name]()
    argument = one_of(rng, sorted(call.arguments))
    value = call.arguments[argument]
    text, odd, refused = hostile(rng, argument, value, argument in call.optional)
    act = lambda: call.function(**{**call.arguments, argument: odd})  # noqa: E731
    told = f"{name}({argument}={text})"
    if name in UNKNOWN and text in {"nan", "inf", "-inf", "a number that is not finite", "all NaN"}:
        refused = None
    if name == "drop_invalid" and text in {"a number that is not finite", "one more axis"}:  # what it is for
        refused = None
    if refused in (False, "same"):
        expected = leaves(call.function(**call.arguments))

        def check(result):
            pairs = zip(leaves(result), expected, strict=True)
            return next((problem for a, b in pairs if (problem := differs(a, b, 1e-5))), None)

        return Case("argument", told, act, check, ANY if refused else ONLY_RIGHT)
    return Case("argument", told, act, not_finite, ONLY_REFUSED if refused else ANY)
