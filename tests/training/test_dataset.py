"""Labelled objects, generated and scanned, and the data sets they make: deterministic, resumable, checked."""

import dataclasses
import json
import os
import subprocess
import sys
import time
import warnings
from pathlib import Path

import numpy as np
import pytest
import trimesh
from scipy.spatial import cKDTree

from tdf_jax._internal.errors import InputError, SizeWarning, TdfWarning
from tdf_jax.geometry.sampling import sample_surface
from tdf_jax.shapes import FAMILIES, build_mug, sample_mug
from tdf_jax.training import dataset
from tdf_jax.training.dataset import DataSet, Recipe, build, joined, load
from tdf_jax.training.labels import BOX_PADDING, canonical_mesh, generated_object, scanned_object

BOX = trimesh.creation.box()
RECIPE = Recipe(seed=5, objects=5, validation=2, points=200, queries=400, cameras=4)


@pytest.fixture(autouse=True)
def quick(monkeypatch):
    monkeypatch.setattr(dataset, "SHARD", 2)
    monkeypatch.setattr("tdf_jax.geometry.views.OCCLUDERS", 2000)


@pytest.fixture(scope="module")
def mug():
    return build_mug(sample_mug(np.random.default_rng([5, 0])))


@pytest.fixture(scope="module")
def labelled():
    return generated_object("mug", np.random.default_rng([5, 0]), points=400, queries=1000, cameras=4)


@pytest.fixture
def meshes(tmp_path):
    """Four mugs as a user may have them: millimetres, y up, the handle towards -z, one of them open."""
    folder = tmp_path / "meshes"
    folder.mkdir()
    turn = np.array([[0.0, -1.0, 0.0], [0.0, 0.0, 1.0], [-1.0, 0.0, 0.0]])  # canonical axes to the file's
    for index in range(4):
        mesh = build_mug(sample_mug(np.random.default_rng([6, index]))).mesh
        mesh = trimesh.Trimesh(
            1000 * mesh.vertices @ turn.T + 7.0, mesh.faces[: -3 if index == 0 else None], process=False
        )
        mesh.export(folder / f"mug{index}.obj")
    (folder / "notes.txt").write_text("not a mesh")
    return folder


def scanned_recipe(folder, **changes):
    return dataclasses.replace(RECIPE, meshes=str(folder), unit=0.001, up="+y", front="-z", **changes)


def quiet_build(recipe, folder, **options):
    build(recipe, folder, progress=False, **options)


# ---- one object ----


def winding_numbers(mesh, points):
    """How often a closed mesh winds around each point, 1 inside, 0 outside, by Van Oosterom's solid angles."""
    corners = mesh.vertices[mesh.faces][None] - points[:, None, None]
    a, b, c = np.moveaxis(corners, 2, 0)
    A, B, C = (np.linalg.norm(corner, axis=-1) for corner in (a, b, c))
    volume = np.einsum("pfi,pfi->pf", a, np.cross(b, c))
    spread = A * B * C + (a * b).sum(-1) * C + (b * c).sum(-1) * A + (c * a).sum(-1) * B
    return 2 * np.arctan2(volume, spread).sum(axis=1) / (4 * np.pi)


def test_labels_and_surfaces_are_those_of_the_mesh(mug, labelled):
    diagonal = labelled.diagonal
    np.testing.assert_allclose(diagonal, np.linalg.norm(mug.mesh.extents), rtol=1e-6)
    chosen = np.r_[:120, 500:620]  # uniform ones, and some near the surface
    inside, x = labelled.inside[chosen], labelled.queries[chosen] * diagonal
    assert 20 < inside.sum() < len(inside) - 20
    np.testing.assert_array_equal(np.round(winding_numbers(mug.mesh, x)), inside)
    dense = cKDTree(sample_surface(mug.mesh, 50_000, np.random.default_rng(0)))
    assert dense.query(labelled.surface * diagonal)[0].max() < 0.01 * diagonal
    assert labelled.visible.shape == (4, 400) and 0.05 < labelled.visible.mean() < 0.6


def test_the_first_half_of_the_queries_is_uniform_in_the_padded_box(mug, labelled):
    low, high = mug.mesh.bounds / labelled.diagonal
    relative = (labelled.queries[:500] - low + BOX_PADDING) / (high - low + 2 * BOX_PADDING)
    assert (relative > -1e-5).all() and (relative < 1 + 1e-5).all()
    np.testing.assert_allclose(relative.mean(axis=0), 0.5, atol=0.06)  # 4.6 standard deviations of the mean
    np.testing.assert_allclose(relative.std(axis=0), np.sqrt(1 / 12), atol=0.03)


def test_places_are_the_mugs_frames_at_unit_diagonal(mug, labelled):
    for place, name in zip(labelled.places, ("handle", "rim", "base"), strict=True):
        expected = mug.frames[name].copy()
        expected[:3, 3] /= labelled.diagonal
        np.testing.assert_allclose(place, expected, atol=1e-6)


def test_a_scanned_mesh_is_labelled_as_the_exact_solid_is(meshes):
    """The open mug is among them: its winding number still tells inside from outside."""
    pytest.importorskip("igl")
    for index in range(2):
        mesh = canonical_mesh(meshes / f"mug{index}.obj", 0.001, "+y", "-z")
        assert mesh.is_watertight == (index == 1)
        mug = build_mug(sample_mug(np.random.default_rng([6, index])))
        middle = mug.mesh.bounds.mean(axis=0)
        found = scanned_object(mesh, np.random.default_rng(0), 300, 2000, 4, stretch=0.0)
        x = found.queries * found.diagonal
        assert np.mean(mug.contains(x + middle) == found.inside) > 0.998
        np.testing.assert_allclose(found.diagonal, np.linalg.norm(mug.mesh.extents), rtol=1e-5)


def test_places_of_a_scanned_mesh_are_its_box_and_stretch_with_it(meshes):
    pytest.importorskip("igl")
    mesh = canonical_mesh(meshes / "mug1.obj", 0.001, "+y", "-z")
    plain, stretched = (
        scanned_object(mesh, np.random.default_rng(3), 4000, 400, 4, stretch=stretch) for stretch in (0.0, 0.3)
    )
    for found in (plain, stretched):
        assert found.places.shape == (7, 4, 4)
        np.testing.assert_allclose(found.places[:, :3, 3].max(axis=0), found.surface.max(axis=0), atol=0.01)
        np.testing.assert_allclose(found.places[:, :3, 3].min(axis=0), found.surface.min(axis=0), atol=0.01)
    shapes = [np.ptp(found.surface, axis=0) for found in (plain, stretched)]
    assert np.abs(shapes[0] - shapes[1]).max() > 0.02


@pytest.mark.parametrize(
    "category, seed, fold",
    [
        ("mug", 0, 1),
        ("bowl", 0, 2),
        ("bowl", 1, 0),
        ("bowl", 18, 4),
        ("bottle", 0, 2),
        ("bottle", 1, 0),
        ("bottle", 3, 1),
        ("bottle", 12, 4),
        ("rack", 0, 1),
        ("rack", 1, 2),
        ("container", 12, 0),
        ("container", 7, 1),
        ("container", 5, 2),
        ("container", 0, 4),
    ],
)
def test_objects_of_every_family_have_its_places_in_order_and_their_own_symmetry(category, seed, fold):
    found = generated_object(category, np.random.default_rng([5, seed]), points=100, queries=100, cameras=4)
    family = FAMILIES[category]
    shape = family.build(family.sample(np.random.default_rng([5, seed])))
    assert found.fold == shape.fold == fold and found.fold.dtype == np.int8
    np.testing.assert_allclose(found.diagonal, np.linalg.norm(shape.mesh.extents), rtol=1e-6)
    for place, name in zip(found.places, family.places, strict=True):
        expected = shape.frames[name].copy()
        expected[:3, 3] /= found.diagonal
        np.testing.assert_allclose(place, expected, atol=1e-6)
    np.testing.assert_array_equal(shape.contains(found.queries.astype(float) * found.diagonal), found.inside)


@pytest.mark.parametrize("fold", [0, 1, 2, 4])
def test_meshes_of_quarter_turns_and_more_stretch_alike_along_x_and_y(fold):
    """So they stay as symmetric as they are; others stretch along every axis on its own."""
    pytest.importorskip("igl")
    box = trimesh.creation.box(extents=(0.3, 0.2, 0.1))
    found = scanned_object(box, np.random.default_rng(3), 100, 100, 4, stretch=0.4, fold=fold)
    assert found.fold == fold and found.fold.dtype == np.int8
    sides = 2 * found.places[1:4, [0, 1, 2], [3, 3, 3]].diagonal() * found.diagonal  # the middles of three faces
    factors = sides / (0.3, 0.2, 0.1)
    assert np.abs(np.log(factors)).max() <= 0.4 and np.abs(np.log(factors[0] / factors[2])) > 0.02
    if fold in (0, 4):
        np.testing.assert_allclose(factors[0], factors[1], rtol=1e-5)
    else:
        assert np.abs(np.log(factors[0] / factors[1])) > 0.02


@pytest.mark.parametrize(
    ("mesh", "message"),
    [
        (trimesh.creation.box(extents=(1, 1, 1e-4)), "encloses almost no volume"),
        (trimesh.Trimesh(BOX.vertices, BOX.faces[:6]), "is open"),
    ],
)
def test_meshes_without_volume_are_refused(mesh, message, tmp_path):
    pytest.importorskip("igl")
    mesh.export(tmp_path / "sheet.obj")
    with pytest.raises(InputError, match=rf"sheet\.obj {message}.*; expected a closed surface"):
        canonical_mesh(tmp_path / "sheet.obj", 1.0, "+z", "+x")


# ---- data sets ----


def same(a, b):
    for field in dataclasses.fields(a):
        np.testing.assert_array_equal(getattr(a, field.name), getattr(b, field.name))


def test_a_data_set_is_its_objects(tmp_path):
    quiet_build(RECIPE, tmp_path / "data")
    training, validation = load(tmp_path / "data")
    assert (len(training.surface), len(validation.surface)) == (5, 2)
    for index in (0, 4):
        expected = generated_object("mug", np.random.default_rng([5, index]), 200, 400, 4)
        for name, array in expected._asdict().items():
            np.testing.assert_array_equal(getattr(training, name)[index], array)
    assert training.uniform == slice(0, 200)
    assert not np.isin(validation.diagonal, training.diagonal).any()
    assert training.digest() != validation.digest()
    names = {path.name for path in (tmp_path / "data").iterdir()}
    assert names == {"dataset.json", *(f"training-000{k}.npz" for k in range(3)), "validation-0000.npz"}


def test_an_interrupted_build_goes_on_to_the_same_data_set(tmp_path, monkeypatch):
    quiet_build(RECIPE, tmp_path / "whole")
    label, count = dataset._label, iter(range(100))

    def killed_at_4(task):
        if next(count) == 4:
            raise KeyboardInterrupt
        return label(task)

    monkeypatch.setattr(dataset, "_label", killed_at_4)
    with pytest.raises(KeyboardInterrupt):
        quiet_build(RECIPE, tmp_path / "cut")
    assert sorted(path.name for path in (tmp_path / "cut").iterdir()) == [
        "dataset.json",
        "training-0000.npz",
        "training-0001.npz",
    ]
    with pytest.raises(InputError, match=r"no training-0002.npz; the data set is not finished. Run its tdf dataset"):
        load(tmp_path / "cut")
    before = (tmp_path / "cut" / "training-0000.npz").stat().st_mtime_ns
    monkeypatch.setattr(dataset, "_label", label)
    quiet_build(RECIPE, tmp_path / "cut")
    assert (tmp_path / "cut" / "training-0000.npz").stat().st_mtime_ns == before
    for a, b in zip(load(tmp_path / "whole"), load(tmp_path / "cut")):
        same(a, b)


def test_a_folder_of_meshes_is_split_and_repeated_stretched(meshes, tmp_path):
    pytest.importorskip("igl")
    quiet_build(scanned_recipe(meshes), tmp_path / "data")
    training, validation = load(tmp_path / "data")
    files = json.loads((tmp_path / "data" / "dataset.json").read_text())["files"]
    assert len(files["training"]) == 3 and len(files["validation"]) == 1
    assert sorted(files["training"] + files["validation"]) == [f"mug{k}.obj" for k in range(4)]
    extents = np.ptp(training.surface, axis=1)
    # Five objects of three meshes: the fourth is the first mesh once more, stretched.
    assert 0.005 < np.abs(extents[3] - extents[0]).max() < 0.3
    assert extents[:, 0].min() > 0.4  # the handle's side
    (meshes / "mug9.obj").write_bytes((meshes / "mug1.obj").read_bytes())
    with pytest.raises(InputError, match=r"holds another data set \(files differ\)"):
        quiet_build(scanned_recipe(meshes), tmp_path / "data")


def test_meshes_nested_as_shapenets_are_found_with_recursive(meshes, tmp_path):
    pytest.importorskip("igl")
    nested = tmp_path / "nested"
    for index, file in enumerate(sorted(meshes.glob("mug*.obj"))):
        (nested / "03797390" / f"a{index}" / "models").mkdir(parents=True)
        file.rename(nested / "03797390" / f"a{index}" / "models" / "model_normalized.obj")
    (nested / "03797390" / "a0" / "all").symlink_to(nested, target_is_directory=True)
    with pytest.raises(
        InputError, match=r"nested holds 0 mesh files; .*\. The folder has 4 meshes in subfolders, .*; add --recursive"
    ):
        quiet_build(scanned_recipe(nested), tmp_path / "data")
    recipe = scanned_recipe(nested, recursive=True)
    quiet_build(recipe, tmp_path / "data")
    files = json.loads((tmp_path / "data" / "dataset.json").read_text())["files"]
    names = [f"03797390/a{index}/models/model_normalized.obj" for index in range(4)]
    assert sorted(files["training"] + files["validation"]) == names
    assert len({one.tobytes() for part in load(tmp_path / "data") for one in part.diagonal}) >= 4  # each is read
    quiet_build(recipe, tmp_path / "data")  # and resumed
    small = nested / "03797390" / "a1" / "models" / "model_normalized.obj"
    trimesh.load_mesh(small).apply_scale(0.001).export(small)
    with pytest.raises(InputError, match=r"03797390/a1/models/model_normalized\.obj measures 0\.000.* one unit"):
        quiet_build(recipe, tmp_path / "other")


def test_meshes_beside_used_ones_are_not_left_out_in_silence(meshes, tmp_path):
    pytest.importorskip("igl")
    (meshes / "more").mkdir()
    (meshes / "more" / "mug9.obj").write_bytes((meshes / "mug1.obj").read_bytes())
    with pytest.warns(
        TdfWarning, match="tdf dataset: .*meshes has 1 mesh in subfolders, which is not used; add --recursive"
    ):
        quiet_build(scanned_recipe(meshes), tmp_path / "data")


def test_the_recipes_symmetry_is_that_of_its_meshes(meshes, tmp_path):
    pytest.importorskip("igl")
    quiet_build(scanned_recipe(meshes, fold=4), tmp_path / "data")
    for part in load(tmp_path / "data"):
        assert (part.fold == 4).all()
    training, _ = load(tmp_path / "data")
    faces = training.places[:, [1, 2, 3], [0, 1, 2], 3]  # middles of the faces at +x, +y and +z
    # The fourth and the fifth object are the first and the second once more, stretched alike along x and y.
    again = faces[3:] / faces[:2]
    np.testing.assert_allclose(again[:, 0], again[:, 1], rtol=1e-5)
    assert np.abs(again[:, 0] / again[:, 2] - 1).min() > 0.01
    with pytest.raises(InputError, match=r"holds another data set \(fold differ\)"):
        quiet_build(scanned_recipe(meshes, fold=0), tmp_path / "data")


@pytest.mark.slow
def test_processes_give_the_same(tmp_path):
    """Started afresh, they see nothing of this test's patches, so with the shipped number of occluders."""
    recipe = dataclasses.replace(RECIPE, objects=2)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("tdf_jax.geometry.views.OCCLUDERS", 100_000)
        quiet_build(recipe, tmp_path / "one")
    quiet_build(recipe, tmp_path / "two", workers=2)
    for a, b in zip(load(tmp_path / "one"), load(tmp_path / "two")):
        same(a, b)


def dying(task):
    os._exit(1)


@pytest.mark.slow
def test_a_process_that_dies_is_named():
    with (
        pytest.raises(InputError, match="a process that labelled objects died.* Use fewer --workers"),
        dataset._mapped(dying, [1, 2, 3], 2) as rows,
    ):
        list(rows)


RUN = """
import sys, time
sys.path.append(sys.argv[1])
from test_dataset import waiting
from tdf_jax.training.dataset import _mapped

if __name__ == "__main__":
    with _mapped(waiting, [1, 2, 3], 2) as rows:
        list(rows)
"""


def waiting(task):
    print(task, flush=True)
    time.sleep(600)


@pytest.mark.slow
def test_a_killed_build_leaves_no_processes(tmp_path):
    script = tmp_path / "run.py"
    script.write_text(RUN)
    with subprocess.Popen([sys.executable, script, Path(__file__).parent], stdout=subprocess.PIPE, text=True) as run:
        assert run.stdout.readline()
        run.kill()
        run.stdout.read()  # ends when the last process that could write there has ended


def test_a_data_set_of_another_family_has_its_objects_and_their_symmetries(tmp_path):
    quiet_build(dataclasses.replace(RECIPE, category="bottle", objects=5), tmp_path / "data")
    training, validation = load(tmp_path / "data")
    for index in range(5):
        expected = generated_object("bottle", np.random.default_rng([5, index]), 200, 400, 4)
        for name, array in expected._asdict().items():
            np.testing.assert_array_equal(getattr(training, name)[index], array)
    assert len(set(training.fold.tolist())) > 1
    assert not training.source.any() and not validation.source.any()
    with pytest.raises(InputError, match=r"holds another data set \(category differ\)"):
        quiet_build(dataclasses.replace(RECIPE, category="bowl", objects=5), tmp_path / "data")


def made_before_symmetries(folder):
    """Takes out of a data set of mugs what was not there before there were families and symmetric objects."""
    manifest = json.loads((folder / "dataset.json").read_text())
    for name in ("category", "fold"):
        del manifest["recipe"][name]
    (folder / "dataset.json").write_text(json.dumps(manifest))
    for path in folder.glob("*.npz"):
        with np.load(path) as arrays:
            arrays = dict(arrays)
        del arrays["fold"]
        np.savez(path, **arrays)


def test_data_sets_made_before_symmetries_load_and_go_on_being_built(tmp_path):
    quiet_build(RECIPE, tmp_path / "new")
    quiet_build(RECIPE, tmp_path / "old")
    made_before_symmetries(tmp_path / "old")
    for a, b in zip(load(tmp_path / "old"), load(tmp_path / "new")):
        same(a, b)
        assert (a.fold == 1).all() and a.digest() == b.digest()
    (tmp_path / "old" / "training-0001.npz").unlink()
    quiet_build(RECIPE, tmp_path / "old")
    for a, b in zip(load(tmp_path / "old"), load(tmp_path / "new")):
        same(a, b)
    with pytest.raises(InputError, match=r"holds another data set \(category differ\)"):
        quiet_build(dataclasses.replace(RECIPE, category="bowl"), tmp_path / "old")


def some(folds, sources=None, places=3, seed=0):
    """A data set of random numbers whose objects have these symmetries."""
    rng, count = np.random.default_rng(seed), len(folds)
    return DataSet(
        surface=rng.normal(size=(count, 6, 3)).astype(np.float32),
        queries=rng.normal(size=(count, 8, 3)).astype(np.float32),
        inside=rng.uniform(size=(count, 8)) < 0.5,
        visible=rng.uniform(size=(count, 4, 6)) < 0.5,
        places=rng.normal(size=(count, places, 4, 4)).astype(np.float32),
        diagonal=rng.uniform(size=count).astype(np.float32),
        fold=np.array(folds, np.int8),
        source=np.zeros(count, int) if sources is None else np.array(sources),
    )


def test_kinds_are_of_one_source_and_symmetry_and_pairs_of_one_kind():
    data = some([0, 4, 0, 2, 0, 4, 0, 1], sources=[0, 0, 0, 0, 1, 1, 1, 1])
    of_sources = [sorted(index for kind in kinds for index in data.kinds[kind].tolist()) for kinds in data.sources]
    assert of_sources == [[0, 1, 2, 3], [4, 5, 6, 7]]
    assert sorted(members.tolist() for members in data.kinds) == [[0, 2], [1], [3], [4, 6], [5], [7]]
    for index, number in enumerate(data.kind):
        assert index in data.kinds[number]
    assert sorted(data.pairs().tolist()) == [[0, 2], [4, 6]]  # those without another of their kind are left out
    odd = some([1, 1, 1, 1, 1])
    assert [members.tolist() for members in odd.kinds] == [[0, 1, 2, 3, 4]]
    np.testing.assert_array_equal(odd.kind, 0)
    assert odd.pairs().tolist() == [[0, 1], [2, 3]]
    assert some([0, 1, 2, 4]).pairs().shape == (0, 2)


def test_joined_data_sets_are_numbered_in_their_order():
    first, second, third = some([1, 1]), some([0, 2, 0], seed=1), some([1], seed=2)
    data = joined([first, second, third])
    np.testing.assert_array_equal(data.source, [0, 0, 1, 1, 1, 2])
    np.testing.assert_array_equal(data.fold, [1, 1, 0, 2, 0, 1])
    for field in dataclasses.fields(DataSet):
        if field.name != "source":
            whole = np.concatenate([getattr(one, field.name) for one in (first, second, third)])
            np.testing.assert_array_equal(getattr(data, field.name), whole)
            assert getattr(data, field.name).dtype == getattr(first, field.name).dtype
    # Of one symmetry, but of other sources: places do not mean the same on them.
    assert sorted(members.tolist() for members in data.kinds) == [[0, 1], [2, 4], [3], [5]]


def test_one_data_set_joined_is_itself():
    one = some([1, 0, 2])
    same(joined([one]), one)
    assert joined([one]).digest() == one.digest()


def test_data_sets_with_other_counts_are_not_joined():
    with pytest.raises(
        InputError,
        match=r"joined\(\): the data sets differ in places; expected the same numbers of points, queries, ",
    ):
        joined([some([1, 1]), some([0, 0], places=7)])
    fewer = some([1, 1])
    fewer = dataclasses.replace(fewer, surface=fewer.surface[:, :5], visible=fewer.visible[:, :, :5])
    with pytest.raises(InputError, match="differ in surface, visible; expected"):
        joined([some([1, 1]), fewer])


def test_a_data_set_of_another_symmetry_is_another_one():
    assert some([1, 1]).digest() != some([0, 0]).digest()


# ---- bad input ----


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"objects": 0}, "objects is 0; expected a whole number of at least 1"),
        ({"validation": 3}, "validation is 3; expected an even number"),
        ({"seed": -1}, "seed is -1"),
        ({"unit": 0.0}, "unit is 0.0; expected a positive number, metres per unit"),
        ({"up": "z"}, "'z' is no axis; expected one of"),
        ({"up": "+x", "front": "-x"}, r"up is \+x and front is -x, which are parallel"),
        ({"stretch": 2.0}, "stretch is 2.0"),
        ({"category": "cup"}, "category is 'cup'; expected one of mug, bowl, bottle"),
        ({"meshes": ".", "fold": 3}, "fold is 3; expected one of 0, 1, 2, 4"),
        ({"fold": 2}, "fold is for meshes; generated objects have their own; omit it"),
        ({"fold": 0, "category": "bowl"}, "fold is for meshes"),
        ({"recursive": True}, "recursive is for meshes, and there are none"),
    ],
)
def test_bad_recipes(changes, message):
    with pytest.raises(InputError, match=message):
        dataclasses.replace(RECIPE, **changes)


def test_meshes_that_are_probably_not_in_metres_are_warned_of(tmp_path):
    pytest.importorskip("igl")
    for index in range(2):
        trimesh.creation.icosphere(subdivisions=1, radius=50.0 + index).export(tmp_path / f"ball{index}.obj")
    recipe, files = scanned_recipe(tmp_path), sorted(tmp_path.glob("*.obj"))
    with pytest.warns(SizeWarning, match="measure 17. m across; .*in millimetres, give --unit 0.001"):
        dataset._check_meshes(dataclasses.replace(recipe, unit=1.0), files, False)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        dataset._check_meshes(dataclasses.replace(recipe, unit=0.001), files, False)


def test_empty_folders_bad_meshes_and_mixed_units_are_refused_before_any_work(meshes, tmp_path):
    pytest.importorskip("igl")
    (tmp_path / "empty").mkdir()
    for folder in (tmp_path / "empty", tmp_path / "missing"):
        with pytest.raises(InputError, match=r"holds 0 mesh files; expected a folder of at least two"):
            quiet_build(scanned_recipe(folder), tmp_path / "data")
    trimesh.creation.box(extents=(1, 1, 1e-4)).export(meshes / "sheet.obj")
    (meshes / "torn.stl").write_bytes(b"solid")
    with pytest.raises(InputError, match=r"2 of 6 meshes are not valid; repair or remove them:\n.*(\n.*)"):
        quiet_build(scanned_recipe(meshes), tmp_path / "data")
    for name in ("sheet.obj", "torn.stl"):
        (meshes / name).unlink()
    trimesh.load_mesh(meshes / "mug1.obj").apply_scale(0.001).export(meshes / "metres.obj")
    with pytest.raises(InputError, match=r"metres\.obj measures 0\.000.* one unit in all files"):
        quiet_build(scanned_recipe(meshes), tmp_path / "data")
    assert not (tmp_path / "data").exists()


def test_a_missing_library_is_named_once(meshes, tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "igl", None)
    with pytest.raises(InputError, match=r"^tdf dataset: libigl is not installed; expected the extra 'mesh'"):
        quiet_build(scanned_recipe(meshes), tmp_path / "data")
    assert not (tmp_path / "data").exists()


def test_other_recipes_and_damaged_files_are_refused(tmp_path):
    quiet_build(RECIPE, tmp_path / "data")
    with pytest.raises(InputError, match=r"holds another data set \(seed, points differ\)"):
        quiet_build(dataclasses.replace(RECIPE, seed=6, points=300), tmp_path / "data")
    shard = tmp_path / "data" / "training-0001.npz"
    shard.write_bytes(shard.read_bytes()[:1000])
    with pytest.raises(
        InputError, match=r"training-0001.npz cannot be read .*delete that file and run the tdf dataset command again"
    ):
        load(tmp_path / "data")
    shard.unlink()
    quiet_build(RECIPE, tmp_path / "data")
    load(tmp_path / "data")
    (tmp_path / "data" / "dataset.json").write_text("{")
    with pytest.raises(InputError, match=r"dataset.json cannot be read"):
        load(tmp_path / "data")
    (tmp_path / "data" / "dataset.json").write_text('{"recipe": {"flavour": 1}}')
    with pytest.raises(InputError, match=r"dataset.json cannot be read .*flavour"):
        load(tmp_path / "data")
    with pytest.raises(InputError, match=r"has no dataset.json; expected a folder made by tdf dataset"):
        load(tmp_path)


def test_a_full_disk_loses_nothing(tmp_path, monkeypatch):
    import errno

    savez, count = np.savez, iter(range(100))

    def full(file, **arrays):
        if next(count) == 1:
            file.write(b"half")
            raise OSError(errno.ENOSPC, "No space left on device")
        savez(file, **arrays)

    monkeypatch.setattr(dataset.np, "savez", full)
    with pytest.raises(InputError, match=r"cannot write .*training-0001.npz .*No space left"):
        quiet_build(RECIPE, tmp_path / "data")
    assert sorted(path.name for path in (tmp_path / "data").iterdir()) == ["dataset.json", "training-0000.npz"]
    quiet_build(RECIPE, tmp_path / "data")
    assert len(load(tmp_path / "data")[0].surface) == 5
