"""Convex parts of users' meshes: hollows stay open, the same again, kept on disk; and the bodies that they make."""

import numpy as np
import pytest
import trimesh
from scipy.spatial import ConvexHull

from tdf_jax._internal.errors import InputError
from tdf_jax.geometry.winding import inside
from tdf_jax.shapes import FAMILIES
from tdf_jax.sim import decomposition
from tdf_jax.sim.decomposition import convex_decomposition, mesh_body

pytest.importorskip("coacd", reason="the extra 'sim' is not installed")

BALL = 0.003  # metres, radius of the ball that is to pass
COARSE = 0.004  # metres
FULL, QUICK = decomposition.SEARCH, {"mcts_iterations": 20, "mcts_nodes": 5, "resolution": 500}


@pytest.fixture(scope="module", autouse=True)
def quick_search():
    """A cup of 28 faces needs no long search; slow tests take the full one."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(decomposition, "SEARCH", QUICK)
        yield


def box(low, high):
    return trimesh.creation.box(bounds=[low, high])


@pytest.fixture(scope="module")
def cup():
    """A square cup, 6 cm wide and 8 cm high, of walls and a floor of 6 mm."""
    return trimesh.boolean.difference(
        [box((-0.03, -0.03, 0), (0.03, 0.03, 0.08)), box((-0.024, -0.024, 0.006), (0.024, 0.024, 0.1))],
        engine="manifold",
    )


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return tmp_path_factory.mktemp("parts")


@pytest.fixture(scope="module")
def parts(cup, folder):
    return convex_decomposition(cup, tolerance=COARSE, folder=folder)


def clearance(parts, points):
    """Least distance of points from the planes of a part beyond which they are, negative inside; (points,)."""
    planes = [ConvexHull(part).equations for part in parts]
    return np.min([np.max(points @ plane[:, :3].T + plane[:, 3], axis=1) for plane in planes], axis=0)


def test_the_parts_of_a_cup_are_its_walls_and_its_hollow_is_open(cup, parts):
    assert 5 <= len(parts) <= 12
    surface, _ = trimesh.sample.sample_surface(cup, 1000, seed=0)
    apart = clearance(parts, np.asarray(surface))
    assert apart.max() < 2e-4  # no material is missing
    assert apart.min() > -COARSE
    x, y, z = np.meshgrid([-0.02, 0, 0.02], [-0.02, 0, 0.02], [0.01, 0.04, 0.08])
    assert clearance(parts, np.stack([x, y, z], axis=-1).reshape(-1, 3)).min() > BALL
    volume = sum(ConvexHull(part).volume for part in parts)
    assert volume == pytest.approx(cup.volume, rel=0.03)


def test_parts_are_corners_of_their_hulls(parts):
    for part in parts:
        assert part.dtype == np.float64 and part.shape[1] == 3
        assert len(ConvexHull(part).vertices) == len(part)


def test_parts_are_the_same_again(cup, parts, tmp_path):
    again = convex_decomposition(cup, tolerance=COARSE, folder=tmp_path)
    assert len(again) == len(parts)
    for one, other in zip(parts, again):
        np.testing.assert_array_equal(one, other)


def test_parts_are_kept_on_disk(cup, parts, folder, monkeypatch):
    monkeypatch.setattr(decomposition, "_decomposed", lambda *about: [np.eye(3)])
    for one, other in zip(parts, convex_decomposition(cup, tolerance=COARSE, folder=folder)):
        np.testing.assert_array_equal(one, other)
    moved = cup.copy()
    moved.apply_translation((0, 0, 0.001))
    for mesh, about in ((moved, {}), (cup, {"tolerance": 0.003}), (cup, {"seed": 1})):  # each is another one
        found = convex_decomposition(mesh, **{"tolerance": COARSE, **about}, folder=folder)
        np.testing.assert_array_equal(found, [np.eye(3)])


def test_the_default_folder_is_in_the_users_cache(cup, tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    monkeypatch.setattr(decomposition, "_decomposed", lambda *about: [np.eye(3)])
    convex_decomposition(cup)
    assert len(list((tmp_path / "tdf_jax" / "decompositions").glob("*.npz"))) == 1


def test_a_body_has_the_mass_and_the_inertia_of_its_mesh(cup, folder):
    body = mesh_body(cup, 0.2, tolerance=COARSE, folder=folder)
    outer, inner = (0.06, 0.06, 0.08), (0.048, 0.048, 0.074)
    volumes = np.array([np.prod(outer), -np.prod(inner)])
    heights = np.array([0.04, 0.043])
    density = 0.2 / volumes.sum()
    centre = volumes @ heights / volumes.sum()
    np.testing.assert_allclose(body.centre, (0, 0, centre), atol=1e-9)
    upright = sum(density * v * (s[0] ** 2 + s[1] ** 2) / 12 for v, s in zip(volumes, (outer, inner)))
    across = sum(
        density * v * ((s[0] ** 2 + s[2] ** 2) / 12 + (h - centre) ** 2)
        for v, s, h in zip(volumes, (outer, inner), heights)
    )
    np.testing.assert_allclose(body.inertia, np.diag([across, across, upright]), rtol=1e-6, atol=1e-12)
    assert body.mass == 0.2
    by_volume = mesh_body(cup, tolerance=COARSE, folder=folder)
    assert by_volume.mass == pytest.approx(np.clip(800 * volumes.sum(), 0.1, 0.4))


def test_a_mesh_that_is_not_closed_has_the_mass_properties_of_its_parts(cup, parts, folder, monkeypatch):
    """The parts of the whole cup stand in for those of one that lacks a face."""
    monkeypatch.setattr(decomposition, "_decomposed", lambda *about: parts)
    open_ = trimesh.Trimesh(cup.vertices, cup.faces[1:], process=False)
    whole, body = (mesh_body(mesh, 0.2, tolerance=COARSE, folder=folder) for mesh in (cup, open_))
    assert not open_.is_watertight
    np.testing.assert_allclose(body.centre, whole.centre, atol=3e-4)
    np.testing.assert_allclose(body.inertia, whole.inertia, rtol=0.02, atol=2e-6)


def test_a_mesh_with_its_faces_turned_inwards_is_closed_first(cup):
    pytest.importorskip("igl", reason="the extra 'mesh' is not installed")
    turned = trimesh.Trimesh(cup.vertices, cup.faces[:, ::-1], process=False)
    vertices, faces = decomposition._closed("f()", turned, turned.vertices, turned.faces, COARSE)
    closed = trimesh.Trimesh(vertices, faces, process=False)
    assert closed.is_watertight and closed.is_winding_consistent
    assert closed.volume == pytest.approx(cup.volume, rel=0.05)
    np.testing.assert_allclose(closed.bounds, cup.bounds, atol=2e-4)
    x, y, z = np.meshgrid([-0.02, 0, 0.02], [-0.02, 0, 0.02], [0.01, 0.04, 0.08])
    points = np.stack([x, y, z], axis=-1).reshape(-1, 3)
    assert not inside(closed, points).any()


def test_a_sheet_encloses_nothing_and_is_refused(cup, folder):
    pytest.importorskip("igl", reason="the extra 'mesh' is not installed")
    sheet = trimesh.Trimesh(cup.vertices, cup.faces[np.abs(cup.face_normals[:, 2]) < 0.5][:12], process=False)
    with pytest.raises(InputError, match=r"convex_decomposition\(\): the mesh is open, and encloses no solid"):
        convex_decomposition(sheet, folder=folder)


@pytest.mark.slow
def test_the_hollow_and_the_finger_hole_of_a_mug_stay_open(tmp_path, monkeypatch):
    monkeypatch.setattr(decomposition, "SEARCH", FULL)
    mug = FAMILIES["mug"].build(FAMILIES["mug"].sample(np.random.default_rng(0)))
    parts = convex_decomposition(mug.mesh, folder=tmp_path)
    assert len(parts) <= 200
    surface, _ = trimesh.sample.sample_surface(mug.mesh, 2000, seed=0)
    assert clearance(parts, np.asarray(surface)).max() < 5e-4  # none of the material is missing
    bottom, top = mug.mesh.bounds[:, 2]
    axis = np.stack([[0, 0, z] for z in np.linspace(bottom + 0.02, top, 20)])
    assert clearance(parts, axis).min() > BALL
    x, z = mug.finger_hole.mean(axis=0)
    assert clearance(parts, np.stack([[x, y, z] for y in np.linspace(-0.03, 0.03, 20)])).min() > BALL


@pytest.mark.parametrize(
    "call, message",
    [
        (lambda cup: convex_decomposition(np.zeros((3, 3))), "got ndarray; expected a trimesh.Trimesh"),
        (lambda cup: convex_decomposition(trimesh.Trimesh()), "has 0 faces"),
        (lambda cup: convex_decomposition(cup.copy().apply_scale(1000)), "the mesh is 80 long; .*apply_scale"),
        (lambda cup: convex_decomposition(cup, tolerance=0), "tolerance is 0"),
        (lambda cup: convex_decomposition(cup, seed=-1), "seed is -1"),
        (lambda cup: mesh_body(cup, mass=0), r"mesh_body\(\): mass is 0"),
    ],
)
def test_wrong_values_are_refused(cup, call, message):
    with pytest.raises(InputError, match=message):
        call(cup)


def test_a_folder_that_cannot_be_made_is_refused(cup, tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(InputError, match="cannot make the folder"):
        convex_decomposition(cup, folder=tmp_path / "file" / "parts")
