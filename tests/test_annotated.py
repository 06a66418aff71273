"""Real meshes: places measured on generated mugs, whose frames are known, and sidecars that must be refused."""

import json
import re
from pathlib import Path

import numpy as np
import pytest
import trimesh

from tdf_jax.errors import InputError
from tdf_jax.evaluation.annotated import load_annotated
from tdf_jax.evaluation.cases import mug_of
from tdf_jax.evaluation.places import body, measured_places
from tdf_jax.meshes import file_axes
from tdf_jax.shapes import build_mug

DOCS = Path(__file__).parent.parent / "docs" / "evaluation.md"
ENTRY = {"unit": 1, "up": "+z", "handle": "+x"}


@pytest.fixture(scope="module")
def mugs():
    return [mug_of(9, index, 0.1) for index in range(20)]


@pytest.fixture
def folder(tmp_path):
    """Writes meshes by name and a sidecar, and gives their folder."""

    def write(meshes, entries):
        for name, mesh in meshes.items():
            mesh.export(tmp_path / name)
        (tmp_path / "meshes.json").write_text(entries if isinstance(entries, str) else json.dumps(entries))
        return tmp_path

    return write


# Places


def test_places_of_generated_mugs_are_found_to_millimetres(mugs):
    errors = {"handle": [], "rim": [], "base": []}
    for mug in mugs:
        moved = mug.mesh.copy().apply_translation([0.3, -0.2, 0.1])
        found = body(moved, "mug")
        np.testing.assert_allclose(found.origin, [0.3, -0.2, 0.1], atol=2e-4)
        assert found.height == pytest.approx(0.1, abs=1e-6)
        for name, T in measured_places(mug.mesh, found.height, "mug").items():
            np.testing.assert_array_equal(T[:3, :3], mug.frames[name][:3, :3])
            errors[name].append(np.linalg.norm(T[:3, 3] - mug.frames[name][:3, 3]))
    assert max(errors["handle"]) < 2.5e-3 and np.median(errors["handle"]) < 5e-4
    assert max(errors["rim"]) < 5e-4 and max(errors["base"]) < 1e-6


def test_an_open_mesh_is_measured_like_a_closed_one(mugs):
    """Every tenth face beside the plane of symmetry is left out: nothing may ask for an inside."""
    mesh = mugs[0].mesh
    beside = (np.abs(mesh.triangles[..., 1]) > 1e-4).all(axis=1)
    holes = trimesh.Trimesh(mesh.vertices, mesh.faces[~beside | (np.arange(len(beside)) % 10 > 0)], process=False)
    assert not holes.is_watertight
    for name, T in measured_places(holes, 0.1, "mug").items():
        np.testing.assert_allclose(T, measured_places(mesh, 0.1, "mug")[name], atol=1e-9)


def test_a_handle_above_the_rim_does_not_raise_the_body(mugs):
    tower = trimesh.creation.box((0.01, 0.01, 0.08), trimesh.transformations.translation_matrix([0.06, 0, 0.05]))
    found = body(trimesh.util.concatenate([mugs[0].mesh, tower]), "mug")
    assert found.height == pytest.approx(0.1, abs=1e-6) and np.abs(found.origin).max() < 1e-3


@pytest.mark.parametrize(("up", "handle"), [("+z", "-x"), ("+z", "+y"), ("+x", "+z"), ("-z", "+x"), ("+y", "+x")])
def test_wrong_axes_of_a_mesh_are_noticed(folder, up, handle):
    where = folder({"mug.obj": build_mug().mesh}, {"mug.obj": ENTRY | {"up": up, "handle": handle}})
    with pytest.raises(InputError, match="mug.obj.*'up'"):
        load_annotated(where)


# Sidecars


@pytest.mark.parametrize(("up", "handle", "unit"), [("+z", "+x", 1), ("-y", "+z", 0.01), ("+x", "-y", 0.001)])
def test_files_of_any_unit_and_axes_come_into_the_canonical_frame(folder, up, handle, unit):
    mug = build_mug()
    T_file_object = np.eye(4)
    T_file_object[:3, :3], T_file_object[:3, 3] = file_axes(up, handle), [0.4, 0.5, -0.6]
    file = mug.mesh.copy().apply_transform(T_file_object).apply_scale(1 / unit)
    given = np.eye(4)
    given[:3, 3] = 0.01, 0.02, 0.03
    entry = {"unit": unit, "up": up, "handle": handle, "places": {"base": given.tolist()}}
    (found,) = load_annotated(folder({"my.stl": file}, {"my.stl": entry}))
    assert found.name == "my" and found.height == pytest.approx(0.1, abs=1e-5)
    np.testing.assert_allclose(found.mesh.bounds, mug.mesh.bounds, atol=1e-5)
    np.testing.assert_allclose(found.frames["handle"], mug.handle_frame, atol=1e-3)
    np.testing.assert_allclose(found.frames["rim"], mug.rim_frame, atol=1e-3)
    np.testing.assert_array_equal(found.frames["base"], given)
    larger = found.scaled(2.0)
    assert larger.height == pytest.approx(0.2, abs=1e-5)
    np.testing.assert_allclose(larger.mesh.bounds, 2 * found.mesh.bounds, atol=1e-9)
    np.testing.assert_allclose(larger.frames["base"][:3, 3], [0.02, 0.04, 0.06])
    np.testing.assert_allclose(larger.frames["rim"][:3, :3], found.frames["rim"][:3, :3])


def place(matrix):
    return {"mug.obj": ENTRY | {"places": {"handle": matrix}}}


BAD_SIDECARS = {
    "no JSON": ("{", "cannot be read as JSON"),
    "a list": ([1], "holds a JSON list"),
    "nothing": ({}, "holds no entry"),
    "another mesh": ({"cup.obj": ENTRY}, "no entry for mug.obj"),
    "a missing mesh": ({"mug.obj": ENTRY, "cup.obj": ENTRY}, "there is no file .*cup.obj"),
    "a missing key": ({"mug.obj": {"unit": 1, "up": "+z"}}, "mug.obj: the entry has the keys unit, up; expected unit, up, handle"),
    "a misspelt key": ({"mug.obj": ENTRY | {"place": {}}}, "mug.obj: .*place; expected"),
    "an entry that is none": ({"mug.obj": 1}, "mug.obj: the entry has a JSON int"),
    "an unknown axis": ({"mug.obj": ENTRY | {"up": "z"}}, r"up is 'z'; expected one of \+x, -x"),
    "a number for an axis": ({"mug.obj": ENTRY | {"handle": 3}}, "handle is 3"),
    "parallel axes": ({"mug.obj": ENTRY | {"handle": "-z"}}, r"up is \+z and handle -z, which are parallel"),
    "unit zero": ({"mug.obj": ENTRY | {"unit": 0}}, "unit is 0; expected metres per unit"),
    "unit in words": ({"mug.obj": ENTRY | {"unit": "cm"}}, "unit is 'cm'"),
    "unit NaN": ('{"mug.obj": {"unit": NaN, "up": "+z", "handle": "+x"}}', "unit is nan"),
    "unit too large": ({"mug.obj": ENTRY | {"unit": 100}}, r"mug.obj has a diagonal of 1[0-9.]+ m with unit 100; .*try 1"),
    "unit too small": ({"mug.obj": ENTRY | {"unit": 0.01}}, r"diagonal of 0.001[0-9]+ m with unit 0.01; .*try 1"),
    "an unknown place": ({"mug.obj": ENTRY | {"places": {"spout": []}}}, "places is .*spout.*handle, rim, base"),
    "a place of another shape": (place([[1, 0], [0, 1]]), r"the place handle has shape \(2, 2\)"),
    "a ragged place": (place([[1, 0], [0]]), "the place handle is no matrix"),
    "a place that is no motion": (place(np.diag([1, 1, -1, 1]).tolist()), "the place handle is no rigid motion"),
}


@pytest.mark.parametrize("name", BAD_SIDECARS)
def test_bad_sidecars(folder, name):
    entries, message = BAD_SIDECARS[name]
    with pytest.raises(InputError, match=message):
        load_annotated(folder({"mug.obj": build_mug().mesh}, entries))


def test_bad_folders(tmp_path):
    with pytest.raises(InputError, match="there is no folder .*none"):
        load_annotated(tmp_path / "none")
    with pytest.raises(InputError, match="is empty"):
        load_annotated(tmp_path)
    (tmp_path / "mug.obj").write_text("v 0 0 0\nv 1 0 0\nv 0 1 0\n")
    with pytest.raises(InputError, match="has no meshes.json"):
        load_annotated(tmp_path)
    (tmp_path / "meshes.json").write_text(json.dumps({"mug.obj": ENTRY}))
    with pytest.raises(InputError, match="mug.obj has no faces"):
        load_annotated(tmp_path)


@pytest.mark.parametrize(("grip", "message"), [("solid", "no handle with a finger hole"), ("open", "its handle is open half way")])
def test_a_handle_that_is_given_need_not_be_measurable(folder, grip, message):
    """One handle is a block, of the other only the ends are left."""
    mug = build_mug()
    body = mug.mesh.copy()
    body.update_faces(~(mug.mesh.triangles[..., 0] > 0.052).any(axis=1))
    if grip == "solid":
        block = trimesh.creation.box((0.05, 0.012, 0.08), trimesh.transformations.translation_matrix([0.06, 0, 0]))
        body = trimesh.util.concatenate([body, block])
    with pytest.raises(InputError, match=f"mug.obj.*{message}"):
        load_annotated(folder({"mug.obj": body}, {"mug.obj": ENTRY}))
    (found,) = load_annotated(folder({"mug.obj": body}, place(mug.handle_frame.tolist())))
    np.testing.assert_array_equal(found.frames["handle"], mug.handle_frame)
    np.testing.assert_allclose(found.frames["rim"], mug.rim_frame, atol=1e-3)


def test_names_are_told_apart(folder):
    with pytest.raises(InputError, match="several meshes called mug"):
        load_annotated(folder({"mug.obj": build_mug().mesh, "mug.stl": build_mug().mesh}, {"mug.obj": ENTRY, "mug.stl": ENTRY}))


@pytest.mark.skipif(not DOCS.exists(), reason="the documentation is not part of a source archive")
def test_the_documented_sidecar_is_read(folder):
    (entries,) = re.findall(r"```json\n(.*?)```", DOCS.read_text(), re.DOTALL)
    meshes = {}
    for name, entry in json.loads(entries).items():
        T_file_object = np.eye(4)
        T_file_object[:3, :3] = file_axes(entry["up"], entry["handle"])
        meshes[name] = build_mug().mesh.copy().apply_transform(T_file_object).apply_scale(1 / entry["unit"])
    for found in load_annotated(folder(meshes, entries)):
        for name, T in build_mug().frames.items():
            np.testing.assert_allclose(found.frames[name], T, atol=1e-3)
