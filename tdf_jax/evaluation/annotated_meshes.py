"""Meshes of real objects with annotations: their unit, their axes and their semantic places.

A folder of meshes has a file `meshes.json`, an object with an entry for each mesh:

    {"mug.obj": {"unit": 0.01, "up": "+y", "handle": "+x"},
     "cup.stl": {"unit": 1, "up": "+z", "handle": "-y", "places": {"handle": [[1, 0, 0, 0.06], ..., [0, 0, 0, 1]]}},
     "bowl.obj": {"category": "bowl", "unit": 1, "up": "+z", "symmetry": "round"},
     "mustard.obj": {"category": "bottle", "unit": 1, "up": "+z", "symmetry": "two-fold", "front": "+x"}}

`unit` is metres per unit of the file; `up` and `handle` are axes of the file. Bowls and bottles have a `symmetry`, one
of `tdf_jax.geometry.symmetry.FOLDS`. Unless they are round, they also have a `front`: an axis of the file, or a
direction [x, y, z] in it, along their longer side or to their handle. `places` are frames T_object_place, 4x4, metres,
in the canonical frame (z up, the handle or front along +x, the origin on the body's axis at mid height). Places that
are not given are measured.

The name of an entry may be a path with slashes. In a folder of folders, each may have its own `meshes.json`.
"""

import dataclasses
import json
import posixpath
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from tdf_jax._internal import checks
from tdf_jax._internal.errors import InputError
from tdf_jax._internal.units import CENTIMETRES, INCHES, METRES, MILLIMETRES
from tdf_jax.evaluation.axis_profiles import profile, profile_places
from tdf_jax.evaluation.places import body, measured_places
from tdf_jax.geometry.symmetry import FOLDS
from tdf_jax.geometry.winding import inside
from tdf_jax.io.mesh_folder import file_names, is_mesh, subfolder_hint, warn_of_subfolders
from tdf_jax.io.meshes import AXES, file_axes, load_mesh
from tdf_jax.shapes import FAMILIES

if TYPE_CHECKING:
    import trimesh

SIDECAR = "meshes.json"
EXPECTED = 'expected {"mug.obj": {"unit": 1, "up": "+z", "handle": "+x"}, ...}'
MOST_NAMED = 5  # meshes without an entry in a message
MEASURED = ("mug", "bowl", "bottle")  # categories whose places can be measured
DIAGONALS = (0.03, 1.0)  # metres; another diagonal means that the unit is probably wrong
# With metres, because the entry may name another unit, and with inches, because the message lists all units that fit.
PROBABLE_UNITS = (METRES, CENTIMETRES, MILLIMETRES, INCHES)
OFF_FRONT = 10.0  # degrees, the largest angle between `front` and the longer side


@dataclasses.dataclass(frozen=True, eq=False)
class AnnotatedMesh:
    """A mesh in its canonical frame, with its semantic places.

    Attributes:
        name: path of its file in the folder, with slashes, without the suffix.
        mesh: the mesh, metres, canonical frame.
        height: height of the body, metres.
        frames: T_object_place, 4x4, by the name of the place.
        category: category of the object.
        fold: symmetry about z, see `tdf_jax.geometry.symmetry`.
    """

    name: str
    mesh: "trimesh.Trimesh"
    height: float
    frames: dict[str, Float[np.ndarray, "4 4"]]
    category: str = "mug"
    fold: int = 1

    def contains(self, points: Float[np.ndarray, "points 3"]) -> Bool[np.ndarray, " points"] | None:
        """Which points lie inside the solid; None for an open surface.

        Args:
            points: points, (points, 3), metres, canonical frame.
        """
        return inside(self.mesh, points)

    def scaled(self, factor: float) -> "AnnotatedMesh":
        """The mesh `factor` times as large, about its origin."""
        grow = np.ones((4, 4))
        grow[:3, 3] = factor
        frames = {name: T * grow for name, T in self.frames.items()}
        return dataclasses.replace(
            self, mesh=self.mesh.copy().apply_scale(factor), height=self.height * factor, frames=frames
        )


def load_annotated(folder: str | Path, recursive: bool = False) -> list[AnnotatedMesh]:
    """Read the meshes that `meshes.json` of a folder names, in the order of their names.

    Args:
        folder: the folder.
        recursive: read the meshes in subfolders too, which `meshes.json` of the folder or of a subfolder names.

    Raises:
        InputError: the folder or the sidecar is missing, an entry is malformed or names a mesh that cannot be used, or
            a mesh lies in the folder without an entry.
    """
    folder = checks.path("load_annotated()", folder, "folder")
    entries = _entries(folder, recursive)
    return [_annotated(folder / name, name, entries[name]) for name in sorted(entries)]


def _entries(folder: Path, recursive: bool) -> dict:
    """The entries by path in the folder; their content is not checked yet."""
    if not folder.is_dir():
        raise InputError(
            f"load_annotated(): there is no folder {folder}; expected one with meshes and their {SIDECAR}; check the "
            "path"
        )
    files = file_names("load_annotated()", folder, recursive)
    hint = "" if recursive else subfolder_hint("load_annotated()", folder)
    hint = hint and f". The folder {hint}, if they have entries"
    if not files and not hint:
        raise InputError(
            f"load_annotated(): the folder {folder} is empty; expected meshes and their {SIDECAR}; put them there"
        )
    sidecars = [name for name in files if Path(name).name == SIDECAR]
    if not sidecars:
        raise InputError(f"load_annotated(): {folder} has no {SIDECAR}; {EXPECTED}; write one{hint}")
    entries, owners = {}, {}
    for sidecar in sidecars:
        inner = sidecar.removesuffix(SIDECAR)
        for name, entry in _sidecar(folder / sidecar).items():
            path = posixpath.normpath(inner + name)
            if path in entries:
                raise InputError(
                    f"load_annotated(): {path} has entries in {owners[path]} and {sidecar} of {folder}; expected one; "
                    "remove the other"
                )
            entries[path], owners[path] = entry, sidecar
    unnamed = [name for name in files if is_mesh(name) and name not in entries]
    if unnamed:
        listed = ", ".join(unnamed[:MOST_NAMED])
        listed += f" and {len(unnamed) - MOST_NAMED} more" if len(unnamed) > MOST_NAMED else ""
        where = folder / sidecars[0] if len(sidecars) == 1 else f"any of the {len(sidecars)} {SIDECAR} in {folder}"
        raise InputError(
            f"load_annotated(): {where} has no entry for {listed}; expected one for each mesh; add it or move the file "
            "away"
        )
    stems = [posixpath.splitext(name)[0] for name in entries]
    twice = sorted({stem for stem in stems if stems.count(stem) > 1})
    if twice:
        raise InputError(
            f"load_annotated(): {folder} has several meshes called {', '.join(twice)}; expected different names; "
            "rename one"
        )
    if not recursive and not any("/" in name for name in entries):
        warn_of_subfolders("load_annotated()", folder)
    return entries


def _sidecar(path: Path) -> dict:
    try:
        entries = json.loads(path.read_text())
    except (OSError, ValueError, RecursionError) as error:
        raise InputError(f"load_annotated(): {path} cannot be read as JSON ({error}); {EXPECTED}; correct it") from None
    if not isinstance(entries, dict) or not entries:
        got = "no entry" if entries == {} else f"a JSON {type(entries).__name__}"
        raise InputError(f"load_annotated(): {path} holds {got}; {EXPECTED}; correct it")
    return entries


class _Entry(NamedTuple):
    """Annotations of a mesh in the sidecar."""

    category: str
    fold: int
    unit: float
    R_file_object: np.ndarray
    places: dict


def _annotated(path: Path, name: str, entry) -> AnnotatedMesh:
    category, fold, unit, R_file_object, given = _checked(path, entry)
    mesh = load_mesh(path, unit)
    _check_size(path, mesh, unit)
    mesh.apply_transform(_homogeneous(R_file_object.T))
    wanted = [place for place in FAMILIES[category].places if place not in given]
    if category == "mug":
        found = body(mesh, path.name)
        mesh.apply_translation(-found.origin)
        places = measured_places(mesh, found.height, path.name, wanted)
    else:
        found = profile(mesh, category, fold, path.name)
        _check_front(path, fold, R_file_object, found.turned)
        mesh.apply_translation(-found.origin)
        places = profile_places(found, category, fold, path.name, wanted)
    return AnnotatedMesh(posixpath.splitext(name)[0], mesh, found.height, places | given, category, fold)


def _checked(path: Path, entry) -> _Entry:
    def refuse(got, expected):
        raise InputError(f"load_annotated(): {SIDECAR}, {path.name}: {got}; expected {expected}; correct the entry")

    if not isinstance(entry, dict):
        refuse(f"the entry has a JSON {type(entry).__name__}", _wanted("mug", False))
    category = entry.get("category", "mug")
    if not isinstance(category, str) or category not in MEASURED:
        refuse(f"category is {category!r}", f"one of {', '.join(MEASURED)}")
    symmetries = {name: fold for fold, name in FOLDS.items()}
    symmetry = "none" if category == "mug" else entry.get("symmetry", "round")
    needed = (
        {"unit", "up", "handle"}
        if category == "mug"
        else {"unit", "up", "symmetry"} | ({"front"} if symmetry != "round" else set())
    )
    known = needed | {"category", "places"} | (set() if category == "mug" else {"front"})
    if not needed <= set(entry) <= known:
        refuse(f"the entry has the keys {', '.join(entry) or 'none'}", _wanted(category, symmetry != "round"))
    if not isinstance(symmetry, str) or symmetry not in symmetries:
        refuse(f"symmetry is {symmetry!r}", f"one of {', '.join(symmetries)}")
    unit = entry["unit"]
    if isinstance(unit, bool) or not isinstance(unit, int | float) or not 0 < unit < np.inf:
        refuse(f"unit is {unit!r}", "metres per unit of the file, a positive number")
    return _Entry(
        category,
        symmetries[symmetry],
        float(unit),
        _axes(entry, category, refuse),
        _given_places(entry, category, refuse),
    )


def _wanted(category: str, has_front: bool) -> str:
    """The keys of an entry in words, for messages."""
    if category == "mug":
        return "unit, up, handle and, if known, places"
    return f"category, unit, up, symmetry{', front' if has_front else ''} and, if known, places"


def _axes(entry: dict, category: str, refuse) -> np.ndarray:
    """Compute R_file_object from the axes `up` and `front` or `handle` of an entry."""
    side, up = "handle" if category == "mug" else "front", entry["up"]
    if not isinstance(up, str) or up not in AXES:
        refuse(f"up is {up!r}", f"one of {', '.join(AXES)}")
    front = entry.get(
        side, next(axis for axis in AXES if not AXES[axis] @ AXES[up])
    )  # any front is right for a round object
    if category != "mug" and isinstance(front, list):
        return _axes_of(up, front, refuse)
    if not isinstance(front, str) or front not in AXES:
        refuse(
            f"{side} is {front!r}",
            f"one of {', '.join(AXES)}" + ("" if category == "mug" else ", or a direction [x, y, z]"),
        )
    if AXES[up] @ AXES[front]:
        refuse(f"up is {up} and {side} {front}, which are parallel", "two different axes")
    return file_axes(up, front)


def _axes_of(up: str, front: list, refuse) -> np.ndarray:
    """Compute R_file_object from a front that is not an axis of the file."""
    try:
        x, z = np.array(front, float), AXES[up]
    except (TypeError, ValueError):
        x = np.zeros(0)
    if x.shape != (3,) or not np.isfinite(x).all() or abs(x @ z) > 1e-3 * np.linalg.norm(x) or not x.any():
        refuse(f"front is {front!r}", f"one of {', '.join(AXES)}, or a direction [x, y, z] across up, which is {up}")
    x = x - x @ z * z
    x = x / np.linalg.norm(x)
    return np.stack([x, np.cross(z, x), z], axis=1)


def _given_places(entry: dict, category: str, refuse) -> dict:
    places, names = entry.get("places", {}), FAMILIES[category].places
    if not isinstance(places, dict) or not set(places) <= set(names):
        refuse(f"places is {places!r}", f"an object with any of {', '.join(names)}")
    return {name: _place(name, place, refuse) for name, place in places.items()}


def _place(name: str, value, refuse_entry) -> np.ndarray:
    def refuse(got):
        refuse_entry(f"the place {name} {got}", "a 4x4 matrix, a rotation and metres")

    try:
        T = np.array(value, float)
    except (TypeError, ValueError):
        refuse("is no matrix of numbers")
    if T.shape != (4, 4) or not np.isfinite(T).all():
        refuse(f"has shape {T.shape}" if T.shape != (4, 4) else "is not finite")
    R = T[:3, :3]
    if np.abs(R @ R.T - np.eye(3)).max() > 1e-4 or np.linalg.det(R) < 0 or np.abs(T[3] - [0, 0, 0, 1]).max() > 0:
        refuse("is no rigid motion")
    return T


def _check_front(path: Path, fold: int, R_file_object: np.ndarray, turned: float) -> None:
    """Raise InputError if the front is not along a side, because all places would then be rotated too."""
    if abs(np.degrees(turned)) <= OFF_FRONT:
        return
    better = R_file_object @ [np.cos(turned), np.sin(turned), 0.0]
    raise InputError(
        f"load_annotated(): {path.name} has its {'longer' if fold == 2 else 'flat'} side "
        f"{np.degrees(abs(turned)):.0f} degrees from 'front'; expected {OFF_FRONT:g} at most; correct it in {SIDECAR}: "
        f'"front": [{", ".join(f"{number + 0.0:.3f}" for number in better)}]'
    )


def _check_size(path: Path, mesh, unit: float) -> None:
    low, high = DIAGONALS
    diagonal = float(np.linalg.norm(mesh.extents))
    if low <= diagonal <= high:
        return
    likely = [f"{metres:g}" for _, metres, _ in PROBABLE_UNITS if low <= diagonal / unit * metres <= high]
    hint = f"; try {' or '.join(likely)}" if likely else ""
    raise InputError(
        f"load_annotated(): {path.name} has a diagonal of {diagonal:.4g} m with unit {unit:g}; expected {low:g} to "
        f"{high:g} m; correct its unit in {SIDECAR}{hint}"
    )


def _homogeneous(R: np.ndarray) -> np.ndarray:
    T = np.eye(4)
    T[:3, :3] = R
    return T
