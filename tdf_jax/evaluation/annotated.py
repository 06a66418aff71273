"""Meshes of real objects with what an evaluation must know of them: their unit, their axes and their semantic places.

A folder of meshes holds one `meshes.json`, an object with an entry for each mesh to use:

    {"mug.obj": {"unit": 0.01, "up": "+y", "handle": "+x"},
     "cup.stl": {"unit": 1, "up": "+z", "handle": "-y", "places": {"handle": [[1, 0, 0, 0.06], ..., [0, 0, 0, 1]]}}}

`unit` is metres per unit of the file; `up` and `handle` are axes of the file. `places` are frames T_object_place, 4x4 in metres, in
the canonical frame (z up, the handle along +x, the origin on the body's axis at mid height); those not given are measured.
"""

import dataclasses
import json
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Bool, Float

from tdf_jax.errors import InputError
from tdf_jax.evaluation.places import PLACES, body, measured_places
from tdf_jax.meshes import AXES, MESH_SUFFIXES, file_axes, inside, load_mesh

if TYPE_CHECKING:
    import trimesh

SIDECAR = "meshes.json"
DIAGONALS = (0.03, 1.0)  # metres; beyond them the unit is more likely wrong than the object a thing to be held
UNITS = (1.0, 0.01, 0.001, 0.0254)  # metres, centimetres, millimetres, inches
KEYS = {"unit", "up", "handle", "places"}


@dataclasses.dataclass(frozen=True, eq=False)
class AnnotatedMesh:
    """A mesh in its canonical frame, with its semantic places.

    Attributes:
        name: of its file, without the ending.
        mesh: metres.
        height: of the body, metres.
        frames: T_object_place, 4x4, by name.
        category: what it is.
        fold: its symmetry about z, see `tdf_jax.symmetry`.
    """

    name: str
    mesh: "trimesh.Trimesh"
    height: float
    frames: dict[str, Float[np.ndarray, "4 4"]]
    category: str = "mug"
    fold: int = 1

    def contains(self, points: Float[np.ndarray, "points 3"]) -> Bool[np.ndarray, "points"] | None:
        """Which points, (points, 3), metres, canonical frame, lie in the clay; None for an open surface."""
        return inside(self.mesh, points)

    def scaled(self, factor: float) -> "AnnotatedMesh":
        """The mesh `factor` times as large, about its origin."""
        grow = np.ones((4, 4))
        grow[:3, 3] = factor
        frames = {name: T * grow for name, T in self.frames.items()}
        return dataclasses.replace(self, mesh=self.mesh.copy().apply_scale(factor), height=self.height * factor, frames=frames)


def load_annotated(folder: str | Path) -> list[AnnotatedMesh]:
    """Read the meshes that a folder's `meshes.json` names, in the order of their names.

    Raises:
        InputError: the folder or the sidecar is missing, an entry is malformed or names a mesh that cannot be used, or a mesh
            lies in the folder without an entry.
    """
    folder = Path(folder)
    entries = _sidecar(folder)
    return [_annotated(folder / name, entries[name]) for name in sorted(entries)]


def _sidecar(folder: Path) -> dict:
    """The entries by file name, of the right shape but not yet checked in themselves."""
    path, expected = folder / SIDECAR, 'expected {"mug.obj": {"unit": 1, "up": "+z", "handle": "+x"}, ...}'
    if not folder.is_dir():
        raise InputError(f"load_annotated(): there is no folder {folder}; expected one with meshes and their {SIDECAR}; check the path")
    if not any(folder.iterdir()):
        raise InputError(f"load_annotated(): the folder {folder} is empty; expected meshes and their {SIDECAR}; put them there")
    if not path.is_file():
        raise InputError(f"load_annotated(): {folder} has no {SIDECAR}; {expected}; write one")
    try:
        entries = json.loads(path.read_text())
    except (OSError, ValueError) as error:
        raise InputError(f"load_annotated(): {path} cannot be read as JSON ({error}); {expected}; correct it") from None
    if not isinstance(entries, dict) or not entries:
        got = "no entry" if entries == {} else f"a JSON {type(entries).__name__}"
        raise InputError(f"load_annotated(): {path} holds {got}; {expected}; correct it")
    unnamed = sorted(file.name for file in folder.iterdir() if file.suffix.lower() in MESH_SUFFIXES and file.name not in entries)
    if unnamed:
        raise InputError(
            f"load_annotated(): {path} has no entry for {', '.join(unnamed)}; expected one for each mesh; add it or move the file away"
        )
    stems = [Path(name).stem for name in entries]
    twice = sorted({stem for stem in stems if stems.count(stem) > 1})
    if twice:
        raise InputError(f"load_annotated(): {path} has several meshes called {', '.join(twice)}; expected different names; rename one")
    return entries


def _annotated(path: Path, entry) -> AnnotatedMesh:
    R_file_object, unit, places = _checked(path, entry)
    mesh = load_mesh(path, unit)
    _check_size(path, mesh, unit)
    mesh.apply_transform(_homogeneous(R_file_object.T))
    found = body(mesh, path.name)
    mesh.apply_translation(-found.origin)
    places = measured_places(mesh, found.height, path.name, set(PLACES) - set(places)) | places
    return AnnotatedMesh(path.stem, mesh, found.height, places)


def _checked(path: Path, entry) -> tuple[np.ndarray, float, dict]:
    """R_file_object, the unit, and the places given."""

    def refuse(got, expected):
        raise InputError(f"load_annotated(): {SIDECAR}, {path.name}: {got}; expected {expected}; correct the entry")

    if not isinstance(entry, dict) or not {"unit", "up", "handle"} <= set(entry) <= KEYS:
        got = f"the keys {', '.join(entry) or 'none'}" if isinstance(entry, dict) else f"a JSON {type(entry).__name__}"
        refuse(f"the entry has {got}", "unit, up, handle and, if known, places")
    unit = entry["unit"]
    if isinstance(unit, bool) or not isinstance(unit, int | float) or not 0 < unit < np.inf:
        refuse(f"unit is {unit!r}", "metres per unit of the file, a positive number")
    for key in ("up", "handle"):
        if not isinstance(entry[key], str) or entry[key] not in AXES:
            refuse(f"{key} is {entry[key]!r}", f"one of {', '.join(AXES)}")
    if AXES[entry["up"]] @ AXES[entry["handle"]]:
        refuse(f"up is {entry['up']} and handle {entry['handle']}, which are parallel", "two different axes")
    places = entry.get("places", {})
    if not isinstance(places, dict) or not set(places) <= set(PLACES):
        refuse(f"places is {places!r}", f"an object with any of {', '.join(PLACES)}")
    return file_axes(entry["up"], entry["handle"]), float(unit), {
        name: _place(place, lambda got: refuse(f"the place {name} {got}", "a 4x4 matrix, a rotation and metres"))
        for name, place in places.items()
    }


def _place(value, refuse) -> np.ndarray:
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


def _check_size(path: Path, mesh, unit: float) -> None:
    low, high = DIAGONALS
    diagonal = float(np.linalg.norm(mesh.extents))
    if low <= diagonal <= high:
        return
    likely = [other for other in UNITS if low <= diagonal / unit * other <= high]
    hint = f"; try {' or '.join(f'{other:g}' for other in likely)}" if likely else ""
    raise InputError(
        f"load_annotated(): {path.name} has a diagonal of {diagonal:.4g} m with unit {unit:g}; expected {low:g} to {high:g} m; "
        f"correct its unit in {SIDECAR}{hint}"
    )


def _homogeneous(R: np.ndarray) -> np.ndarray:
    T = np.eye(4)
    T[:3, :3] = R
    return T
