"""Real meshes: places measured on generated objects whose frames are known, and sidecars that must be refused."""

import json
import re
from pathlib import Path

import numpy as np
import pytest
import trimesh

from tdf_jax._internal.errors import InputError, TdfWarning
from tdf_jax.evaluation.annotated_meshes import load_annotated
from tdf_jax.evaluation.axis_profiles import profile, profile_places
from tdf_jax.evaluation.cases import mug_of
from tdf_jax.evaluation.places import body, measured_places
from tdf_jax.geometry.symmetry import FOLDS
from tdf_jax.io.meshes import file_axes
from tdf_jax.shapes import FAMILIES, BottleParameters, BowlParameters, build_bottle, build_bowl, build_mug

DOCS = Path(__file__).parents[2] / "docs" / "guide" / "evaluation.md"
ENTRY = {"unit": 1, "up": "+z", "handle": "+x"}


BOWL = {"category": "bowl", "unit": 1, "up": "+z", "symmetry": "round"}
BOTTLE = {"category": "bottle", "unit": 1, "up": "+z", "symmetry": "two-fold", "front": "+x"}
FLAT = BottleParameters(aspect=0.7)
DEFAULTS = {
    "mug": {"none": build_mug},
    "bowl": {"round": build_bowl, "two-fold": lambda: build_bowl(BowlParameters(aspect=0.7))},
    "bottle": {
        "round": build_bottle,
        "two-fold": lambda: build_bottle(FLAT),
        "four-fold": lambda: build_bottle(BottleParameters(squareness=5.0)),
        "none": lambda: build_bottle(BottleParameters(handle=True)),
    },
}


@pytest.fixture(scope="module")
def mugs():
    return [mug_of(9, index, 0.1) for index in range(20)]


@pytest.fixture(scope="module")
def sampled():
    """Bowls and bottles of several seeds, by category, some of every fold."""
    families = {name: FAMILIES[name] for name in ("bowl", "bottle")}
    return {
        name: [family.build(family.sample(np.random.default_rng([14, seed]))) for seed in range(16)]
        for name, family in families.items()
    }


def places_of(mesh, shape):
    """The profile of a mesh of a shape, and its places."""
    found = profile(mesh, shape.category, shape.fold, shape.category)
    return found, profile_places(found, shape.category, shape.fold, shape.category, FAMILIES[shape.category].places)


def in_file(mesh, up, front, unit):
    """A mesh in canonical axes as a file has it, away from the file's origin."""
    T_file_object = np.eye(4)
    T_file_object[:3, :3], T_file_object[:3, 3] = file_axes(up, front), [0.4, 0.5, -0.6]
    return mesh.copy().apply_transform(T_file_object).apply_scale(1 / unit)


def rotated(mesh, degrees, axis=(0, 0, 1)):
    return mesh.copy().apply_transform(trimesh.transformations.rotation_matrix(np.radians(degrees), axis))


def moved_vertices(mesh, vertices):
    return trimesh.Trimesh(vertices, mesh.faces, process=False)


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
def test_wrong_axes_of_a_mesh_are_reported(folder, up, handle):
    where = folder({"mug.obj": build_mug().mesh}, {"mug.obj": ENTRY | {"up": up, "handle": handle}})
    with pytest.raises(InputError, match="mug.obj.*'up'"):
        load_annotated(where)


# Profiles

# Metres: the median and the largest distance from the truth. Under a wide cap the neck's own radius is a guess.
TOLERANCE = {
    "bowl": {"rim": (4e-4, 2e-3), "base": (1e-5, 1e-4), "body": (1e-9, 1e-9)},
    "bottle": {"neck": (5e-4, 6e-3), "base": (1e-5, 1e-4), "body": (5e-4, 4e-3)},
}


@pytest.mark.slow
@pytest.mark.parametrize("category", ["bowl", "bottle"])
def test_places_of_generated_bowls_and_bottles_are_found_to_millimetres(sampled, category):
    errors = {place: [] for place in FAMILIES[category].places}
    for shape in sampled[category]:
        moved = shape.mesh.copy().apply_translation([0.3, -0.2, 0.1])
        found, places = places_of(moved, shape)
        np.testing.assert_allclose(found.origin, [0.3, -0.2, 0.1], atol=1e-4)
        assert found.height == pytest.approx(shape.height, abs=1e-4)
        assert abs(found.turned) < 0.01
        assert list(places) == list(errors)
        for name, T in places.items():
            np.testing.assert_array_equal(T[:3, :3], np.eye(3))
            errors[name].append(np.linalg.norm(T[:3, 3] - shape.frames[name][:3, 3]))
    for name, (middle, most) in TOLERANCE[category].items():
        assert np.median(errors[name]) < middle and max(errors[name]) < most, (name, errors[name])


def test_the_sampled_shapes_have_every_symmetry(sampled):
    assert {shape.fold for shape in sampled["bowl"]} == {0, 2, 4}
    assert {shape.fold for shape in sampled["bottle"]} == {0, 1, 2, 4}


@pytest.mark.slow
@pytest.mark.parametrize("category", ["bowl", "bottle"])
def test_scans_are_measured_like_clean_meshes(sampled, category):
    """A tenth of the faces is missing, vertices are off by 0.3 mm, all leans by a degree."""
    rng = np.random.default_rng(3)
    for shape in sampled[category][3:7]:
        mesh, (clean, places) = shape.mesh, places_of(shape.mesh, shape)
        holes = trimesh.Trimesh(mesh.vertices, mesh.faces[rng.random(len(mesh.faces)) > 0.1], process=False)
        assert not holes.is_watertight
        noisy = moved_vertices(mesh, mesh.vertices + 3e-4 * rng.normal(size=mesh.vertices.shape))
        for scan, most in ((holes, 1e-3), (noisy, 3e-3), (rotated(mesh, 1.0, (1, 0.3, 0)), 5e-3)):
            found, others = places_of(scan, shape)
            for name, T in others.items():
                assert np.linalg.norm(found.origin + T[:3, 3] - clean.origin - places[name][:3, 3]) < most, name


def test_a_missing_sector_is_no_hindrance(sampled):
    """Of 20 degrees, all the height; of 120 degrees it is one."""
    for shape in [next(shape for shape in sampled[category] if shape.fold == 0) for category in ("bowl", "bottle")]:
        x, y, _ = shape.mesh.triangles_center.T
        aside = np.abs(np.degrees(np.arctan2(y, x)) - 45)
        cut, large = (
            trimesh.Trimesh(shape.mesh.vertices, shape.mesh.faces[aside > half], process=False) for half in (10, 60)
        )
        _, places = places_of(cut, shape)
        for name, T in places_of(shape.mesh, shape)[1].items():
            np.testing.assert_allclose(places[name], T, atol=1e-3)
        with pytest.raises(InputError, match=r"no surface in [0-9]+ of 48 directions|is not round"):
            places_of(large, shape)


def test_a_stray_vertex_moves_no_axis():
    """Of a bowl's rim, 5 cm outwards and upwards; the middle of the bounding box moves by 2.5 cm."""
    bowl = build_bowl()
    vertices = np.array(bowl.mesh.vertices)
    vertices[np.argmax(vertices @ [1, 0.3, 1])] += 0.05
    found, places = places_of(moved_vertices(bowl.mesh, vertices), bowl)
    np.testing.assert_allclose(found.origin, 0, atol=5e-4)
    np.testing.assert_allclose(places["rim"], bowl.frames["rim"], atol=1e-3)


def test_the_axis_of_a_bottle_with_a_handle_is_that_of_its_neck():
    """A body and handle that stand off the neck, as a watering can's, do not move it."""
    bottle = build_bottle(BottleParameters(handle=True))
    vertices = np.array(bottle.mesh.vertices)
    vertices[:, 0] += 0.01 * np.clip((0.02 - vertices[:, 2]) / 0.02, 0, 1)  # below the shoulder
    found, _ = places_of(moved_vertices(bottle.mesh, vertices), bottle)
    np.testing.assert_allclose(found.origin, 0, atol=1e-4)


def test_a_pouring_lip_does_not_move_the_axis_of_a_bowl():
    bowl = build_bowl()
    vertices = np.array(bowl.mesh.vertices)
    lip = (vertices[:, 2] > 0.01) & (vertices[:, 0] > 0.05)
    vertices[lip, 0] += 0.02 * (vertices[lip, 2] - 0.01) / 0.02
    found = profile(moved_vertices(bowl.mesh, vertices), "bowl", 1, "bowl")
    np.testing.assert_allclose(found.origin, 0, atol=1e-4)
    rim = profile_places(found, "bowl", 1, "bowl", ["rim"])["rim"]
    np.testing.assert_allclose(rim[:3, 3], bowl.frames["rim"][:3, 3] + [0.02, 0, 0], atol=2e-3)


@pytest.mark.parametrize("angle", [-35.0, 35.0])
@pytest.mark.parametrize(
    ("category", "symmetry"), [("bowl", "two-fold"), ("bottle", "two-fold"), ("bottle", "four-fold")]
)
def test_a_rotated_side_is_measured(category, symmetry, angle):
    shape = DEFAULTS[category][symmetry]()
    found = profile(rotated(shape.mesh, angle), category, shape.fold, category)
    assert np.degrees(found.turned) == pytest.approx(angle, abs=1.0)


@pytest.mark.parametrize("turn", [((1, 0, 0), 180), ((0, 1, 0), 90), ((0, 1, 0), -90), ((1, 0, 0), 90)])
@pytest.mark.parametrize("category", ["bowl", "bottle"])
def test_a_bowl_or_bottle_that_does_not_stand_is_reported(sampled, category, turn):
    axis, degrees = turn
    for shape in sampled[category][2:6]:
        with pytest.raises(InputError, match="'up'"):
            places_of(rotated(shape.mesh, degrees, axis), shape)


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


@pytest.mark.parametrize(("up", "front", "unit"), [("+z", "+x", 1), ("-y", "+z", 0.01), ("+x", "-y", 0.001)])
@pytest.mark.parametrize(
    ("category", "symmetry"), [(category, name) for category in ("bowl", "bottle") for name in DEFAULTS[category]]
)
def test_bowl_and_bottle_files_come_into_the_canonical_frame(folder, category, symmetry, up, front, unit):
    shape = DEFAULTS[category][symmetry]()
    given = np.eye(4)
    given[:3, 3] = 0.01, 0.02, 0.03
    entry = {
        "category": category,
        "unit": unit,
        "up": up,
        "symmetry": symmetry,
        "front": front,
        "places": {"base": given.tolist()},
    }
    (found,) = load_annotated(folder({"my.stl": in_file(shape.mesh, up, front, unit)}, {"my.stl": entry}))
    assert (found.name, found.category, found.fold) == ("my", category, shape.fold) and FOLDS[found.fold] == symmetry
    assert found.height == pytest.approx(shape.height, abs=1e-5)
    np.testing.assert_allclose(found.mesh.bounds, shape.mesh.bounds, atol=1e-5)
    assert set(found.frames) == set(FAMILIES[category].places)
    np.testing.assert_array_equal(found.frames.pop("base"), given)
    for name, T in found.frames.items():
        np.testing.assert_allclose(T, shape.frames[name], atol=2e-3)


@pytest.mark.parametrize("up", ["+x", "-y", "+z"])
def test_round_objects_need_no_front(folder, up):
    front = next(axis for axis in ("+x", "+y") if axis[1] != up[1])
    (found,) = load_annotated(
        folder({"bowl.obj": in_file(build_bowl().mesh, up, front, 1)}, {"bowl.obj": BOWL | {"up": up}})
    )
    for name, T in found.frames.items():
        np.testing.assert_allclose(T, build_bowl().frames[name], atol=1e-3)


def test_a_front_may_be_a_direction_and_must_be_that_of_the_longer_side(folder):
    bottle = build_bottle(FLAT)
    meshes = {"my.obj": rotated(bottle.mesh, -23.0)}
    with pytest.raises(
        InputError, match=r'my.obj has its longer side 23 degrees from \'front\'; .*"front": \[0.92., -0.39., 0.000\]'
    ) as refused:
        load_annotated(folder(meshes, {"my.obj": BOTTLE}))
    hint = json.loads(re.search(r"\[.*\]", str(refused.value))[0])
    for front in (hint, [200 * number for number in hint]):
        (found,) = load_annotated(folder(meshes, {"my.obj": BOTTLE | {"front": front}}))
        np.testing.assert_allclose(found.mesh.bounds, bottle.mesh.bounds, atol=1e-3)
    with pytest.raises(InputError, match=r"my.obj has its flat side 23 degrees"):
        load_annotated(
            folder(
                {"my.obj": rotated(DEFAULTS["bottle"]["four-fold"]().mesh, 23.0)},
                {"my.obj": BOTTLE | {"symmetry": "four-fold"}},
            )
        )


@pytest.mark.parametrize(
    ("symmetry", "mesh", "message"),
    [
        ("round", FLAT, "my.obj is not round: a turn of 90 degrees .*'symmetry'"),
        ("round", BottleParameters(squareness=5.0), "my.obj is not round: a turn of 45 degrees"),
        ("four-fold", FLAT, "my.obj is not four-fold: a turn of 90 degrees"),
        (
            "none",
            BottleParameters(handle=True),
            "my.obj reaches 3.6 cm from its axis to its front and 7.4 cm to another side.*'front'",
        ),
    ],
)
def test_another_symmetry_than_the_mesh_has_is_reported(folder, symmetry, mesh, message):
    entry = BOTTLE | {"symmetry": symmetry, "front": "+y" if symmetry == "none" else "+x"}
    with pytest.raises(InputError, match=message):
        load_annotated(folder({"my.obj": build_bottle(mesh).mesh}, {"my.obj": entry}))


def test_places_that_cannot_be_measured_may_be_given(folder):
    """A can has no neck, a bowl under its lid no rim."""
    can = trimesh.creation.cylinder(0.03, 0.12, sections=64).subdivide()
    lid = trimesh.creation.cylinder(
        0.076, 0.004, transform=trimesh.transformations.translation_matrix([0, 0, 0.03]), sections=64
    )
    meshes = {"can.obj": can, "pot.obj": trimesh.util.concatenate([build_bowl().mesh, lid])}
    entries = {"can.obj": BOWL | {"category": "bottle"}, "pot.obj": BOWL}
    with pytest.raises(
        InputError, match="can.obj cannot be measured: nothing above its body is narrow enough .*'places'"
    ):
        load_annotated(folder(meshes, entries))
    neck, rim = np.eye(4), np.eye(4)
    neck[2, 3], rim[0, 3] = 0.04, 0.07
    entries["can.obj"] |= {"places": {"neck": neck.tolist(), "body": np.eye(4).tolist()}}
    with pytest.raises(InputError, match="pot.obj cannot be measured: it is closed above; is 'up' right.*'places'"):
        load_annotated(folder(meshes, entries))
    entries["pot.obj"] = BOWL | {"places": {"rim": rim.tolist()}}
    can, pot = load_annotated(folder(meshes, entries))
    np.testing.assert_array_equal(can.frames["neck"], neck)
    np.testing.assert_array_equal(pot.frames["rim"], rim)
    np.testing.assert_allclose(can.frames["base"][:3, 3], [0, 0, -0.06], atol=1e-5)
    np.testing.assert_allclose(pot.frames["base"][:3, 3], [0, 0, -0.031], atol=1e-5)


def test_a_bowl_and_a_bottle_scale_with_their_symmetry(folder):
    (found,) = load_annotated(folder({"my.obj": build_bottle(FLAT).mesh}, {"my.obj": BOTTLE}))
    larger = found.scaled(2.0)
    assert (larger.category, larger.fold) == ("bottle", 2) and larger.height == pytest.approx(0.44, abs=1e-4)


def place(matrix):
    return {"mug.obj": ENTRY | {"places": {"handle": matrix}}}


BAD_SIDECARS = {
    "no JSON": ("{", "cannot be read as JSON"),
    "a list": ([1], "holds a JSON list"),
    "nothing": ({}, "holds no entry"),
    "another mesh": ({"cup.obj": ENTRY}, "no entry for mug.obj"),
    "a missing mesh": ({"mug.obj": ENTRY, "cup.obj": ENTRY}, "there is no file .*cup.obj"),
    "a missing key": (
        {"mug.obj": {"unit": 1, "up": "+z"}},
        "mug.obj: the entry has the keys unit, up; expected unit, up, handle",
    ),
    "a misspelt key": ({"mug.obj": ENTRY | {"place": {}}}, "mug.obj: .*place; expected"),
    "an entry that is none": ({"mug.obj": 1}, "mug.obj: the entry has a JSON int"),
    "an unknown axis": ({"mug.obj": ENTRY | {"up": "z"}}, r"up is 'z'; expected one of \+x, -x"),
    "a number for an axis": ({"mug.obj": ENTRY | {"handle": 3}}, "handle is 3"),
    "parallel axes": ({"mug.obj": ENTRY | {"handle": "-z"}}, r"up is \+z and handle -z, which are parallel"),
    "unit zero": ({"mug.obj": ENTRY | {"unit": 0}}, "unit is 0; expected metres per unit"),
    "unit in words": ({"mug.obj": ENTRY | {"unit": "cm"}}, "unit is 'cm'"),
    "unit NaN": ('{"mug.obj": {"unit": NaN, "up": "+z", "handle": "+x"}}', "unit is nan"),
    "unit too large": (
        {"mug.obj": ENTRY | {"unit": 100}},
        r"mug.obj has a diagonal of 1[0-9.]+ m with unit 100; .*try 1",
    ),
    "unit too small": ({"mug.obj": ENTRY | {"unit": 0.01}}, r"diagonal of 0.001[0-9]+ m with unit 0.01; .*try 1"),
    "an unknown place": ({"mug.obj": ENTRY | {"places": {"spout": []}}}, "places is .*spout.*handle, rim, base"),
    "a place of another shape": (place([[1, 0], [0, 1]]), r"the place handle has shape \(2, 2\)"),
    "a ragged place": (place([[1, 0], [0]]), "the place handle is no matrix"),
    "a place that is no motion": (place(np.diag([1, 1, -1, 1]).tolist()), "the place handle is no rigid motion"),
    "an unknown category": (
        {"mug.obj": ENTRY | {"category": "cup"}},
        "category is 'cup'; expected one of mug, bowl, bottle",
    ),
    "a category that is no name": ({"mug.obj": ENTRY | {"category": ["mug"]}}, r"category is \['mug'\]"),
    "a mug's symmetry": ({"mug.obj": ENTRY | {"symmetry": "none"}}, "the keys .*symmetry; expected unit, up, handle"),
    "a bowl's handle": ({"mug.obj": ENTRY | BOWL}, "the keys .*handle.*; expected category, unit, up, symmetry and"),
    "a bowl without symmetry": (
        {"mug.obj": {"category": "bowl", "unit": 1, "up": "+z"}},
        "the keys category, unit, up; expected category, unit, up, symmetry",
    ),
    "an oval bowl without front": (
        {"mug.obj": BOWL | {"symmetry": "two-fold"}},
        "expected category, unit, up, symmetry, front",
    ),
    "an unknown symmetry": (
        {"mug.obj": BOTTLE | {"symmetry": "oval"}},
        "symmetry is 'oval'; expected one of round, none, two-fold, four-fold",
    ),
    "a symmetry that is no name": ({"mug.obj": BOTTLE | {"symmetry": [2]}}, r"symmetry is \[2\]"),
    "an unknown front": ({"mug.obj": BOTTLE | {"front": "x"}}, r"front is 'x'; expected one of \+x, .*direction"),
    "a round bowl's unknown front": ({"mug.obj": BOWL | {"front": "x"}}, "front is 'x'"),
    "a parallel front": ({"mug.obj": BOTTLE | {"front": "-z"}}, r"up is \+z and front -z, which are parallel"),
    "a direction along up": (
        {"mug.obj": BOTTLE | {"front": [0.7, 0, 0.7]}},
        r"front is \[0.7, 0, 0.7\]; .*across up, which is \+z",
    ),
    "a direction of nothing": ({"mug.obj": BOTTLE | {"front": [0, 0, 0]}}, r"front is \[0, 0, 0\]"),
    "a direction of words": ({"mug.obj": BOTTLE | {"front": ["a", 0, 0]}}, r"front is \['a', 0, 0\]"),
    "a mug's direction": ({"mug.obj": ENTRY | {"handle": [1, 0, 0]}}, r"handle is \[1, 0, 0\]; expected one of"),
    "a mug's place on a bowl": (
        {"mug.obj": BOWL | {"places": {"handle": np.eye(4).tolist()}}},
        "places is .*handle.*any of rim, base, body",
    ),
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


def test_folders_of_folders(folder, tmp_path):
    """A sidecar at the top names meshes below by their paths; a folder below may have its own."""
    bowl = build_bowl().mesh
    for name in ("bowls/a/models", "bowls/b/models"):
        (tmp_path / name).mkdir(parents=True)
    names = [f"bowls/{name}/models/model_normalized.obj" for name in "ab"]
    folder({"top.obj": bowl, names[0]: bowl, names[1]: bowl}, {"top.obj": BOWL, names[0]: BOWL})
    assert [one.name for one in load_annotated(tmp_path)] == ["bowls/a/models/model_normalized", "top"]
    with pytest.raises(InputError, match=f"meshes.json has no entry for {names[1]}; expected one for each mesh"):
        load_annotated(tmp_path, recursive=True)
    inner = tmp_path / "bowls" / "b" / "meshes.json"
    inner.write_text(json.dumps({"models/model_normalized.obj": BOWL | {"unit": 0.5}}))
    found = load_annotated(tmp_path, recursive=True)
    assert [one.name for one in found] == [*(name.removesuffix(".obj") for name in names), "top"]
    assert found[1].height == pytest.approx(0.5 * found[0].height)
    inner.write_text(json.dumps({"../a/models/model_normalized.obj": BOWL}))
    with pytest.raises(InputError, match=f"{names[0]} has entries in bowls/b/meshes.json and meshes.json of"):
        load_annotated(tmp_path, recursive=True)


def test_meshes_below_are_counted_where_they_are_not_read(folder, tmp_path):
    (tmp_path / "more").mkdir()
    build_bowl().mesh.export(tmp_path / "more" / "a.obj")
    with pytest.raises(InputError, match=r"has no meshes.json; .*\. The folder has 1 mesh in subfolders, .*, if they"):
        load_annotated(tmp_path)
    with pytest.warns(TdfWarning, match="has 1 mesh in subfolders, which is not used; add --recursive"):
        (found,) = load_annotated(folder({"my.obj": build_bowl().mesh}, {"my.obj": BOWL}))
    assert found.name == "my"


@pytest.mark.parametrize(
    ("grip", "message"),
    [("solid", "no handle with a finger hole"), ("open", r"its handle is open half way between its ends\. Expected")],
)
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


def test_names_are_distinguished(folder):
    with pytest.raises(InputError, match="several meshes called mug"):
        load_annotated(
            folder({"mug.obj": build_mug().mesh, "mug.stl": build_mug().mesh}, {"mug.obj": ENTRY, "mug.stl": ENTRY})
        )


@pytest.mark.skipif(not DOCS.exists(), reason="the documentation is not part of a source archive")
def test_the_documented_sidecar_is_read(folder):
    (entries,) = re.findall(r"```json\n(.*?)```", DOCS.read_text(), re.DOTALL)
    meshes, shapes = {}, {}
    for name, entry in json.loads(entries).items():
        shapes[Path(name).stem] = shape = DEFAULTS[entry.get("category", "mug")][entry.get("symmetry", "none")]()
        front = (
            entry.get("handle")
            or entry.get("front")
            or next(axis for axis in ("+x", "+y") if axis[1] != entry["up"][1])
        )
        meshes[name] = in_file(shape.mesh, entry["up"], front, entry["unit"])
    for found in load_annotated(folder(meshes, entries)):
        for name, T in shapes[found.name].frames.items():
            np.testing.assert_allclose(found.frames[name], T, atol=1e-3)
