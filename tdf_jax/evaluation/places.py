"""Semantic places of a mug's mesh, measured on its section along the plane of symmetry.

They are those of `tdf_jax.shapes.Mug`: the canonical frame's origin on the body's axis at mid height, z up, the handle
along +x, and frames T_object_place of the handle, the rim and the base. Surfaces may be open: nothing is asked of the
inside.
"""

import dataclasses
from collections.abc import Collection
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Float

from tdf_jax._internal.errors import InputError

if TYPE_CHECKING:
    import trimesh

PLACES = ("handle", "rim", "base")
LEVELS = 1000  # horizontal lines through the section: 0.1 mm apart on a common mug
CLEAR = (0.02, 0.05)  # of the height, from the wall: where an arm of the handle is cut, past most fillets
BELOW_RIM = 0.01  # of the height: where the wall's middle is taken, within the rounding of its edges
OFF_AXIS = 0.15  # of the radius: how far from the axis the body may be widest across


@dataclasses.dataclass(frozen=True)
class Body:
    """Where the body of a mug lies in the frame it was measured in.

    Attributes:
        origin: on the axis at mid height, (3,), metres.
        radius: half the extent across the plane of symmetry, metres.
        height: metres.
    """

    origin: Float[np.ndarray, "3"]
    radius: float
    height: float


def body(mesh: "trimesh.Trimesh", name: str) -> Body:
    """Find the body of a mug whose handle points along +x, z up; a handle that reaches over the rim does not count.

    Args:
        mesh: metres.
        name: of the mesh, for messages.

    Raises:
        InputError: nothing reaches out along +x alone.
    """
    x, y, z = np.asarray(mesh.vertices)[np.unique(mesh.faces)].T
    radius, middle = np.ptp(y) / 2, (y.min() + y.max()) / 2
    axis = x.min() + radius
    widest = x[np.abs(y - middle) > 0.995 * radius]  # of a square mug, all along two sides
    # A handle along -x shifts the axis by its reach, one along y widens the body: both put the widest part off the
    # axis.
    if x.max() < axis + 1.1 * radius or abs((widest.min() + widest.max()) / 2 - axis) > OFF_AXIS * radius:
        raise InputError(
            f"body(): {name} has no handle along the axis given as 'handle': it is {100 * np.ptp(x):.1f} cm long that way and "
            f"{100 * np.ptp(y):.1f} cm across; expected a body that is symmetric but for the handle; correct 'handle' and 'up'"
        )
    opposite = z[x < axis]
    low, high = opposite.min(), opposite.max()
    return Body(np.array([axis, middle, (low + high) / 2]), float(radius), float(high - low))


def measured_places(
    mesh: "trimesh.Trimesh", height: float, name: str, places: Collection[str] = PLACES
) -> dict[str, Float[np.ndarray, "4 4"]]:
    """Frames of the handle, the rim and the base of a mug in its canonical frame.

    The handle's origin is on its centre line, half way between its attachments, on the outermost branch; an attachment
    is where the centre line of an arm, continued straight, meets the middle of the wall.

    Args:
        mesh: canonical frame, metres.
        height: of the body, metres.
        name: of the mesh, for messages.
        places: those to measure, of `PLACES`.

    Returns:
        T_object_place, 4x4, by the names of `tdf_jax.shapes.Mug.frames`.

    Raises:
        InputError: the mesh is not an open cup, or has no handle with a finger hole, where one of these is to be
            measured.
    """
    found = {"base": frame(0.0, -height / 2)}
    if set(places) - set(found):
        section = _section(mesh)
        levels = (np.arange(LEVELS) + 0.5) / LEVELS * height - height / 2
        # On the side without the handle, outer surface last.
        walls = [np.sort(-row[row < 0]) for row in (crossings(section, level) for level in levels)]
        if any(len(row) < 2 for row in walls[3 * LEVELS // 4 : -LEVELS // 100]):
            raise _unmeasured(name, "its upper quarter is no open cup with a wall; is 'up' right?")
        if crossings(section[..., ::-1], 0.0).max(initial=-np.inf) > height / 4:
            raise _unmeasured(name, "it is closed above; is 'up' right?")
        found["rim"] = frame(-float(walls[-1 - int(BELOW_RIM * LEVELS)][-2:].mean()), height / 2, -1.0)
        if "handle" in places:
            found["handle"] = frame(*_grip(section, height, walls, name))
    return {place: found[place] for place in PLACES if place in places}


def frame(x: float, z: float, outward: float = 1.0) -> Float[np.ndarray, "4 4"]:
    """T_object_frame at (x, 0, z), z up, its x axis along object x times `outward` (1 or -1)."""
    T = np.diag([outward, outward, 1.0, 1.0])
    T[:3, 3] = x, 0.0, z
    return T


def _grip(section, height: float, walls, name: str) -> tuple[float, float]:
    """The handle's origin, (x, z)."""
    step = height / LEVELS
    thickness = float(np.median([row[-1] - row[-2] for row in walls[LEVELS // 2 : -LEVELS // 50]]))
    outer = np.array([row[-1] for row in walls[LEVELS // 50 : -LEVELS // 50]])
    outer = np.pad(outer, LEVELS // 50, mode="edge")  # without the roundings, and on beyond rim and base
    low, high = section[..., 1].min(), section[..., 1].max()
    levels = np.arange(low + step / 2, high, step)
    wall = np.interp(levels, (np.arange(LEVELS) + 0.5) * step - height / 2, outer)
    rows = [crossings(section, level) for level in levels]
    middles = []
    for clear in (share * height for share in CLEAR):
        beyond = np.array([np.sum(row > edge + clear) for row, edge in zip(rows, wall)])
        # Going outward from here, an odd number of surfaces is crossed from within clay, an even one from within air.
        arm = np.flatnonzero(beyond % 2)
        gaps = np.diff(arm)
        if len(arm) < 2 or gaps.max() * step < 0.1 * height:
            raise _unmeasured(name, "no handle with a finger hole is found; is 'handle' right?")
        split = np.argmax(gaps) + 1
        middles.append([(levels[part[0]] + levels[part[-1]]) / 2 for part in (arm[:split], arm[split:])])
    near, far = np.array(middles)
    share = (CLEAR[0] * height + thickness / 2) / ((CLEAR[1] - CLEAR[0]) * height)
    z = float(np.mean(near + share * (near - far)))
    bar = crossings(section, z)[-2:]  # inner and outer surface
    if bar[0] < np.interp(z, levels, wall) + CLEAR[0] * height:
        raise _unmeasured(name, "its handle is open half way between its ends")
    return float(bar.mean()), z


def _section(mesh) -> np.ndarray:
    """Line segments (segments, 2, 2) of the surface in the x-z plane."""
    from trimesh.intersections import mesh_plane

    # Beside the plane of symmetry by less than any mesh is accurate: vertices lie in the plane itself, often whole
    # edges.
    return mesh_plane(mesh, plane_normal=[0, 1, 0], plane_origin=[0, 1e-6, 0])[..., [0, 2]]


def crossings(section, level: float) -> np.ndarray:
    """Where segments cross the line at a second coordinate, sorted."""
    a, b = section[:, 0], section[:, 1]
    crossing = (a[:, 1] > level) != (b[:, 1] > level)
    a, b = a[crossing], b[crossing]
    return np.sort(a[:, 0] + (level - a[:, 1]) / (b[:, 1] - a[:, 1]) * (b[:, 0] - a[:, 0]))


def _unmeasured(name: str, what: str) -> InputError:
    return InputError(
        f"measured_places(): {name} cannot be measured: {what} Expected a cup, open above, with a closed handle: "
        "correct its 'up' and 'handle', or give 'places' for it"
    )
