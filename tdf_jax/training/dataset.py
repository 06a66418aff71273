"""Data sets of labelled objects in a folder of shards; building one can be resumed and depends only on its recipe."""

import concurrent.futures
import concurrent.futures.process
import contextlib
import dataclasses
import functools
import json
import multiprocessing
import warnings
from collections.abc import Sequence
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Int
from tqdm.auto import tqdm

from tdf_jax._internal import checks, workers
from tdf_jax._internal.cache import digest
from tdf_jax._internal.errors import InputError, SizeWarning
from tdf_jax._internal.files import replace_file
from tdf_jax.geometry.symmetry import FOLDS
from tdf_jax.geometry.winding import libigl
from tdf_jax.io.mesh_folder import file_names, is_mesh, subfolder_hint, warn_of_subfolders
from tdf_jax.io.meshes import MESH_SUFFIXES, file_axes
from tdf_jax.shapes import FAMILIES
from tdf_jax.training.labels import UNIFORM_SHARE, Labelled, canonical_mesh, generated_object, scanned_object

MANIFEST = "dataset.json"
SHARD = 50  # objects in a file of 9 MB, which is what an interruption can lose
SPLITS = ("training", "validation")
VALIDATION_SEED = 1_000_003  # added to the recipe's seed; objects are a function of (seed, index)
BITS = "inside", "visible"  # fields stored as single bits
HELD_OUT = 10  # one mesh file in so many is held out for validation, at least one
PLAUSIBLE = (0.01, 3.0)  # metres, between which the median of the objects' diagonals raises no doubt of the unit
UNIT_SPREAD = 20.0  # largest diagonal over the smallest in a folder; a larger ratio means that units are mixed


@dataclasses.dataclass(frozen=True)
class Recipe:
    """Settings of a data set; the defaults are the generated mugs of the shipped mug network.

    Attributes:
        seed: seed of every draw; different seeds give different generated objects.
        objects: number of training objects. Every mesh of a folder is used in turn, and stretched from the second time
            on.
        validation: number of validation objects, even. Those of a folder are made from its held-out meshes, a tenth.
        points: surface points of an object.
        queries: labelled query points of an object, half uniform in the padded bounding box, half near the surface.
        cameras: cameras around an object, from which partial clouds are seen.
        category: category of generated objects: mug, bowl, bottle, rack or container.
        meshes: folder of aligned meshes of one category, instead of generated objects.
        unit: metres per unit of the mesh files.
        up: axis of the mesh files that points up.
        front: axis of the mesh files that points to the front, such as a mug's handle, or along a longer side.
        fold: symmetry of the meshes about the up axis: 1 none; 2 half turns, 4 quarter turns, 0 all turns leave them
            unchanged.
        stretch: repeated meshes are scaled along every axis by a random factor of up to e to this.
        recursive: use the meshes in subfolders too, such as ShapeNet's 02876657/ID/models/model_normalized.obj.
    """

    seed: int = 0
    objects: int = 1200
    validation: int = 24
    points: int = 3000
    queries: int = 12000
    cameras: int = 16
    category: str = "mug"
    meshes: str | None = None
    unit: float = 1.0
    up: str = "+z"
    front: str = "+x"
    fold: int = 1
    stretch: float = 0.15
    recursive: bool = False

    def __post_init__(self):
        lowest = {"seed": 0, "objects": 1, "validation": 2, "points": 100, "queries": 100, "cameras": 4}
        for name, low in lowest.items():
            checks.count("Recipe()", name, getattr(self, name), low)
        checks.choice("Recipe()", "category", self.category, FAMILIES)
        checks.choice("Recipe()", "fold", self.fold, FOLDS)
        if self.meshes is None and self.fold != 1:
            raise InputError("Recipe(): fold is for meshes; generated objects have their own; omit it")
        if self.meshes is None and self.recursive:
            raise InputError("Recipe(): recursive is for meshes, and there are none; omit it, or name their folder")
        if self.validation % 2:
            raise InputError(
                f"Recipe(): validation is {self.validation}; expected an even number, objects come in pairs"
            )
        checks.positive("Recipe()", "unit", self.unit, unit="metres per unit of the files, such as 0.001")
        checks.number("Recipe()", "stretch", self.stretch, 0, 1)
        file_axes(self.up, self.front)


@dataclasses.dataclass(frozen=True)
class DataSet:
    """Objects in their canonical frame (up +z; front, handle or long side +x), scaled to a diagonal of 1.

    The fields are those of `Labelled`, with an axis of objects. `source` numbers the data set that an object is from.
    """

    surface: Float[np.ndarray, "objects points 3"]
    queries: Float[np.ndarray, "objects queries 3"]
    inside: Bool[np.ndarray, "objects queries"]
    visible: Bool[np.ndarray, "objects cameras points"]
    places: Float[np.ndarray, "objects places 4 4"]
    diagonal: Float[np.ndarray, " objects"]
    fold: Int[np.ndarray, " objects"]
    source: Int[np.ndarray, " objects"]

    @property
    def uniform(self) -> slice:
        """Slice of the query points that are uniform in the padded box."""
        return slice(0, int(self.queries.shape[1] * UNIFORM_SHARE))

    @cached_property
    def sources(self) -> list[list[int]]:
        """Numbers in `kinds` of the kinds of every source."""
        source = [self.source[members[0]] for members in self.kinds]
        return [np.flatnonzero(source == one).tolist() for one in np.unique(source)]

    @cached_property
    def kinds(self) -> list[Int[np.ndarray, " members"]]:
        """Indices of the objects of every kind; they share a source and a symmetry, and their places correspond."""
        kinds = np.stack([self.source, self.fold], axis=1)
        return [np.flatnonzero((kinds == kind).all(axis=1)) for kind in np.unique(kinds, axis=0)]

    @cached_property
    def kind(self) -> Int[np.ndarray, " objects"]:
        """Number in `kinds` of every object's kind."""
        kind = np.empty(len(self.fold), int)
        for number, members in enumerate(self.kinds):
            kind[members] = number
        return kind

    def pairs(self) -> Int[np.ndarray, "pairs 2"]:
        """Every object paired with another of its kind; without the last one of an odd number."""
        return np.concatenate([members[: len(members) // 2 * 2].reshape(-1, 2) for members in self.kinds])

    def digest(self) -> str:
        """Digest of the contents, by which a resumed run recognises its data."""
        # Data sets without symmetry keep the digests that they had before there were others.
        symmetry = b"" if (self.fold == 1).all() else self.fold.astype(np.int8).tobytes()
        return digest(self.surface, self.inside, symmetry)[:16]


def build(recipe: Recipe, directory: str | Path, workers: int = 1, progress: bool = True) -> None:
    """Label the objects of a recipe into a folder, or resume an interrupted call.

    Args:
        recipe: settings of the data set.
        directory: folder that receives `dataset.json` and a .npz file for every `SHARD` objects.
        workers: number of processes.
        progress: whether to show a progress bar.

    Raises:
        InputError: meshes of the recipe are not valid, or the folder holds another data set or cannot be written.
    """
    directory = Path(directory)
    splits = _mesh_files(recipe)
    manifest = {
        "recipe": dataclasses.asdict(recipe),
        "files": {name: [_short(recipe, file) for file in files] for name, files in splits.items()},
    }
    if not _claimed(directory, manifest):
        _check_meshes(recipe, [file for files in splits.values() for file in files], progress)
        try:
            directory.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise InputError(
                f"tdf dataset: cannot make the folder {directory} ({error}); expected a writable place"
            ) from None
        replace_file("tdf dataset", directory / MANIFEST, json.dumps(manifest, indent=1).encode())
    missing = [shard for shard in _shards(recipe) if not (directory / shard[0]).exists()]
    tasks = [(recipe, splits[split], split, index) for _, split, indices in missing for index in indices]
    with _mapped(_label, tasks, workers) as rows:
        rows = iter(tqdm(rows, desc="labelling objects", total=len(tasks), disable=not progress))
        for name, _, indices in missing:
            columns = zip(*(next(rows) for _ in indices), strict=True)
            arrays: dict[str, Any] = dict(zip(Labelled._fields, map(np.stack, columns), strict=True))
            arrays |= {field: np.packbits(arrays[field], axis=-1) for field in BITS}
            replace_file("tdf dataset", directory / name, lambda file, arrays=arrays: np.savez(file, **arrays))


def load(directory: str | Path) -> tuple[DataSet, DataSet]:
    """Read the training and the validation objects of a data set.

    Args:
        directory: folder from `build`.

    Raises:
        InputError: the folder holds no data set, an unfinished one, or a damaged file.
    """
    directory = Path(directory)
    if not (directory / MANIFEST).exists():
        raise InputError(f"load(): {directory} has no {MANIFEST}; expected a folder made by tdf dataset")
    recipe = _read(directory / MANIFEST, lambda file: Recipe(**json.load(file)["recipe"]))
    parts: dict[str, list[Labelled]] = {split: [] for split in SPLITS}
    for name, split, indices in _shards(recipe):
        if not (directory / name).exists():
            raise InputError(
                f"load(): {directory} has no {name}; the data set is not finished. Run its tdf dataset command again"
            )
        unpacked = functools.partial(_unpacked, recipe=recipe, count=len(indices))
        parts[split].append(_read(directory / name, unpacked))
    training, validation = (_collected(parts[split]) for split in SPLITS)
    return training, validation


def joined(sets: Sequence[DataSet]) -> DataSet:
    """Join data sets for a network of several categories; `source` numbers them.

    Args:
        sets: data sets from `load`, whose objects have the same numbers of points, queries, cameras and places.

    Raises:
        InputError: these numbers differ.
    """
    shapes = [{name: getattr(one, name).shape[1:] for name in Labelled._fields} for one in sets]
    different = [name for name in shapes[0] if any(shape[name] != shapes[0][name] for shape in shapes)]
    if different:
        raise InputError(
            f"joined(): the data sets differ in {', '.join(different)}; expected the same numbers of points, queries, "
            "cameras and places an object. Build them with the same options"
        )
    columns = {name: np.concatenate([getattr(one, name) for one in sets]) for name in Labelled._fields}
    return DataSet(**columns, source=np.repeat(np.arange(len(sets)), [len(one.fold) for one in sets]))


def _collected(parts) -> DataSet:
    columns = [np.concatenate(column) for column in zip(*parts)]
    return DataSet(*columns, source=np.zeros(len(columns[0]), int))


def _shards(recipe):
    """File name, split and indices of every shard."""
    for split, count in zip(SPLITS, (recipe.objects, recipe.validation)):
        for start in range(0, count, SHARD):
            yield f"{split}-{start // SHARD:04d}.npz", split, range(start, min(start + SHARD, count))


def _unpacked(file, recipe, count):
    with np.load(file, allow_pickle=False) as arrays:
        arrays = dict(arrays)
    sizes = {"surface": recipe.points, "queries": recipe.queries}
    for name, size in sizes.items():  # bits do not tell their number
        if arrays[name].shape != (count, size, 3):
            raise ValueError(f"its {name} have shape {arrays[name].shape}; expected {(count, size, 3)}")
    for field, size in zip(BITS, (recipe.queries, recipe.points), strict=True):
        arrays[field] = np.unpackbits(arrays[field], axis=-1, count=size).astype(bool)
    arrays.setdefault("fold", np.ones(count, np.int8))  # data sets made before there were symmetric objects
    labelled = Labelled(**arrays)
    if any(len(array) != count for array in labelled):
        raise ValueError(f"expected {count} objects")
    return labelled


def _read(path, parse):
    try:
        with path.open("rb") as file:
            return parse(file)
    except Exception as error:  # damaged files raise whatever their parser stumbles on
        reason = str(error).splitlines()[0] if str(error) else type(error).__name__
        raise InputError(
            f"load(): {path} cannot be read ({reason}); delete that file and run the tdf dataset command again, "
            "which makes only what is missing"
        ) from None


def _claimed(directory, manifest):
    """Whether the folder holds this data set, finished or not; another data set is refused."""
    if not (directory / MANIFEST).exists():
        return False
    old = _read(directory / MANIFEST, lambda file: dict(json.load(file)))
    defaults = dataclasses.asdict(Recipe())
    before = defaults | old.get("recipe", {})
    changed = [name for name in manifest["recipe"] if before[name] != manifest["recipe"][name]]
    changed += ["files"] * (old.get("files") != manifest["files"])
    if changed:
        raise InputError(
            f"tdf dataset: {directory} holds another data set ({', '.join(changed)} differ); expected the same. "
            "Choose another folder, or delete this one."
        )
    return True


def _mesh_files(recipe) -> dict[str, list[Path]]:
    """Mesh files of each split; none for generated objects."""
    if recipe.meshes is None:
        return {split: [] for split in SPLITS}
    folder = Path(recipe.meshes)
    names = file_names("tdf dataset", folder, recipe.recursive) if folder.is_dir() else []
    files = [folder / name for name in names if is_mesh(name)]
    if len(files) < 2:
        hint = subfolder_hint("tdf dataset", folder) if folder.is_dir() and not recipe.recursive else ""
        raise InputError(
            f"tdf dataset: {folder} holds {len(files)} mesh files; expected a folder of at least two "
            f"({', '.join(MESH_SUFFIXES)}), aligned, of one category{hint and '. The folder ' + hint}"
        )
    if not recipe.recursive:
        warn_of_subfolders("tdf dataset", folder)
    held_out = max(1, len(files) // HELD_OUT)
    files = [files[index] for index in np.random.default_rng(recipe.seed).permutation(len(files))]
    return {"training": files[held_out:], "validation": files[:held_out]}


def _short(recipe, file: Path) -> str:
    """Path of a mesh relative to the recipe's folder."""
    return file.relative_to(recipe.meshes).as_posix()


def _check_meshes(recipe, files, progress):
    """Check that every mesh loads and encloses a volume, and that their sizes have one unit."""
    if not files:
        return
    libigl("tdf dataset")
    diagonals, problems = {}, []
    for file in tqdm(files, desc="checking meshes", disable=not progress):
        try:
            diagonals[_short(recipe, file)] = float(
                np.linalg.norm(canonical_mesh(file, recipe.unit, recipe.up, recipe.front).extents)
            )
        except InputError as error:
            problems.append(str(error))
    if problems:
        listed = "\n  ".join(problems)
        raise InputError(
            f"tdf dataset: {len(problems)} of {len(files)} meshes are not valid; repair or remove them:\n  {listed}"
        )
    small, large = min(diagonals, key=diagonals.__getitem__), max(diagonals, key=diagonals.__getitem__)
    if diagonals[large] > UNIT_SPREAD * diagonals[small]:
        raise InputError(
            f"tdf dataset: {small} measures {diagonals[small]:.3g} m across and {large} {diagonals[large]:.3g} m; "
            "expected one unit in all files. Rescale some"
        )
    median = float(np.median(list(diagonals.values())))
    if not PLAUSIBLE[0] <= median <= PLAUSIBLE[1]:
        warnings.warn(
            f"tdf dataset: the meshes measure {median:.3g} m across; expected objects in metres. They are learnt in "
            "any unit, but if they are in millimetres, give --unit 0.001, in centimetres --unit 0.01",
            SizeWarning,
            stacklevel=2,
        )


def _label(task) -> Labelled:
    """Label one object, which depends on the recipe, the split and the index only."""
    recipe, files, split, index = task
    rng = np.random.default_rng([recipe.seed + (VALIDATION_SEED if split == "validation" else 0), index])
    counts = recipe.points, recipe.queries, recipe.cameras
    if not files:
        return generated_object(recipe.category, rng, *counts)
    mesh = canonical_mesh(files[index % len(files)], recipe.unit, recipe.up, recipe.front)
    return scanned_object(mesh, rng, *counts, stretch=recipe.stretch if index >= len(files) else 0.0, fold=recipe.fold)


@contextlib.contextmanager
def _mapped(function, tasks, count):
    """Results in the order of the tasks; processes are spawned because a forked copy of a threaded one may hang."""
    if count < 2 or len(tasks) < 2:
        yield map(function, tasks)
        return
    context = multiprocessing.get_context("spawn")
    with concurrent.futures.ProcessPoolExecutor(count, context, workers.begin) as pool:
        try:
            yield pool.map(function, tasks)
        except concurrent.futures.process.BrokenProcessPool:
            raise InputError(
                "tdf dataset: a process that labelled objects died, perhaps for lack of memory; expected it to live. "
                "Use fewer --workers, and run again to resume"
            ) from None
        finally:
            pool.shutdown(cancel_futures=True)  # otherwise an interruption waits for all submitted tasks
