"""Semantic places of a mug's mesh, measured on its section along the plane of symmetry.

Frames are as in `tdf_jax.shapes.Mug`: the origin of the canonical frame is on the body's axis at mid height, z points
up and the handle along +x, and T_object_place are frames of the handle, the rim and the base. The mesh may be open,
because no measurement needs its inside.
"""

import dataclasses
from collections.abc import Collection
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Float

from tdf_jax._internal.errors import InputError
from tdf_jax.shapes.shape import frame

if TYPE_CHECKING:
    import trimesh

PLACES = ("handle", "rim", "base")
LEVELS = 1000  # horizontal lines through the section; they are 0.1 mm apart on a common mug
# Shares of the height: distances from the wall at which an arm of the handle is cut, beyond most fillets.
CLEAR = (0.02, 0.05)
BELOW_RIM = 0.01  # share of the height: the middle of the wall is measured this far below the rounded rim
OFF_AXIS = 0.15  # share of the radius: largest distance between the axis and the widest part of the body


@dataclasses.dataclass(frozen=True)
class Body:
    """Measurements of the body of a mug, in the frame of its mesh.

    Attributes:
        origin: point on the axis at mid height, (3,), metres.
        radius: half of the extent across the plane of symmetry, metres.
        height: height, metres.
    """

    origin: Float[np.ndarray, "3"]
    radius: float
    height: float


def body(mesh: "trimesh.Trimesh", name: str) -> Body:
    """Measure the body of a mug whose handle points along +x, z up; a handle above the rim does not change it.

    Args:
        mesh: the mesh, metres.
        name: name of the mesh, for messages.

    Raises:
        InputError: the mesh has no handle along +x alone.
    """
    x, y, z = np.asarray(mesh.vertices)[np.unique(mesh.faces)].T
    radius, middle = np.ptp(y) / 2, (y.min() + y.max()) / 2
    axis = x.min() + radius
    # A square mug is widest all along two sides.
    widest = x[np.abs(y - middle) > 0.995 * radius]
    # A handle along -x shifts the axis, and a handle along y widens the body. Both move the widest part off the axis.
    if x.max() < axis + 1.1 * radius or abs((widest.min() + widest.max()) / 2 - axis) > OFF_AXIS * radius:
        raise InputError(
            f"body(): {name} has no handle along the axis given as 'handle': it is {100 * np.ptp(x):.1f} cm long that "
            f"way and {100 * np.ptp(y):.1f} cm across; expected a body that is symmetric but for the handle; correct "
            "'handle' and 'up'"
        )
    opposite = z[x < axis]
    low, high = opposite.min(), opposite.max()
    return Body(np.array([axis, middle, (low + high) / 2]), float(radius), float(high - low))


def measured_places(
    mesh: "trimesh.Trimesh", height: float, name: str, places: Collection[str] = PLACES
) -> dict[str, Float[np.ndarray, "4 4"]]:
    """Frames of the handle, the rim and the base of a mug in its canonical frame.

    The origin of the handle is on its centre line, half way between its attachments, on the outermost branch. An
    attachment is the point where the centre line of an arm, continued straight, meets the middle of the wall.

    Args:
        mesh: the mesh, metres, canonical frame.
        height: height of the body, metres.
        name: name of the mesh, for messages.
        places: places to measure, of `PLACES`.

    Returns:
        T_object_place, 4x4, by the names of `tdf_jax.shapes.Mug.frames`.

    Raises:
        InputError: a place needs an open cup, or a handle with a finger hole, and the mesh has none.
    """
    found = {"base": frame(0.0, -height / 2)}
    if set(places) - set(found):
        section = _section(mesh)
        levels = (np.arange(LEVELS) + 0.5) / LEVELS * height - height / 2
        # Walls on the side without the handle; the outer surface is last.
        walls = [np.sort(-row[row < 0]) for row in (crossings(section, level) for level in levels)]
        if any(len(row) < 2 for row in walls[3 * LEVELS // 4 : -LEVELS // 100]):
            raise _unmeasured(name, "its upper quarter is no open cup with a wall; is 'up' right?")
        if crossings(section[..., ::-1], 0.0).max(initial=-np.inf) > height / 4:
            raise _unmeasured(name, "it is closed above; is 'up' right?")
        found["rim"] = frame(-float(walls[-1 - int(BELOW_RIM * LEVELS)][-2:].mean()), height / 2, -1.0)
        if "handle" in places:
            found["handle"] = frame(*_grip(section, height, walls, name))
    return {place: found[place] for place in PLACES if place in places}


def _grip(section, height: float, walls, name: str) -> tuple[float, float]:
    """The origin of the handle, (x, z)."""
    step = height / LEVELS
    thickness = float(np.median([row[-1] - row[-2] for row in walls[LEVELS // 2 : -LEVELS // 50]]))
    outer = np.array([row[-1] for row in walls[LEVELS // 50 : -LEVELS // 50]])
    outer = np.pad(outer, LEVELS // 50, mode="edge")  # leaves out the rounded edges, and continues beyond rim and base
    low, high = section[..., 1].min(), section[..., 1].max()
    levels = np.arange(low + step / 2, high, step)
    wall = np.interp(levels, (np.arange(LEVELS) + 0.5) * step - height / 2, outer)
    rows = [crossings(section, level) for level in levels]
    middles = []
    for clear in (share * height for share in CLEAR):
        beyond = np.array([np.sum(row > edge + clear) for row, edge in zip(rows, wall)])
        # A ray from here to the outside crosses an odd number of surfaces if it starts inside the solid.
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
        raise _unmeasured(name, "its handle is open half way between its ends.")
    return float(bar.mean()), z


def _section(mesh) -> np.ndarray:
    """Line segments of the surface in the x-z plane, (segments, 2, 2)."""
    from trimesh.intersections import mesh_plane

    # The plane is moved by less than the accuracy of any mesh, because vertices, and often whole edges, lie in the
    # plane of symmetry itself.
    return np.asarray(mesh_plane(mesh, plane_normal=[0, 1, 0], plane_origin=[0, 1e-6, 0]))[..., [0, 2]]


def crossings(section, level: float) -> np.ndarray:
    """First coordinates at which segments cross a line of constant second coordinate, in rising order.

    Args:
        section: line segments, (segments, 2, 2), metres.
        level: second coordinate of the line, metres.
    """
    a, b = section[:, 0], section[:, 1]
    crossing = (a[:, 1] > level) != (b[:, 1] > level)
    a, b = a[crossing], b[crossing]
    return np.sort(a[:, 0] + (level - a[:, 1]) / (b[:, 1] - a[:, 1]) * (b[:, 0] - a[:, 0]))


def _unmeasured(name: str, what: str) -> InputError:
    return InputError(
        f"measured_places(): {name} cannot be measured: {what} Expected a cup, open above, with a closed handle: "
        "correct its 'up' and 'handle', or give 'places' for it"
    )
