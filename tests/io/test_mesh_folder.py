"""Folders of meshes as users have them: nested, linked in circles, with what operating systems leave in them."""

import os

import pytest

from tdf_jax._internal.errors import InputError, TdfWarning
from tdf_jax.io import mesh_folder
from tdf_jax.io.mesh_folder import file_names, is_mesh, subfolder_hint, warn_of_subfolders

NESTED = ("02876657/a1/models/model_normalized.obj", "02876657/a1/models/model_normalized.mtl", "02876657/b2/x.OBJ")
HINT = "has 1 mesh in subfolders, which is not used; add --recursive, or recursive=True"


@pytest.fixture
def folder(tmp_path):
    """A category of ShapeNet, beside a mesh and what is none."""
    root = tmp_path / "meshes"
    for name in (*NESTED, "top.stl", "._top.stl", "notes.txt", ".hidden/c.obj", "__MACOSX/._d.obj", "odd.obj/e.ply"):
        (root / name).parent.mkdir(parents=True, exist_ok=True)
        (root / name).touch()
    return root


def meshes(folder, recursive):
    return [name for name in file_names("f()", folder, recursive) if is_mesh(name)]


def test_meshes_of_subfolders_are_found_on_request(folder):
    assert meshes(folder, False) == ["top.stl"]
    assert meshes(folder, True) == [NESTED[0], NESTED[2], "odd.obj/e.ply", "top.stl"]
    assert "02876657/a1/models/model_normalized.mtl" in file_names("f()", folder, True)


def test_links_are_followed_and_circles_end(folder, tmp_path):
    other = tmp_path / "elsewhere"
    (other / "deep").mkdir(parents=True)
    (other / "deep" / "f.off").touch()
    before = meshes(folder, True)
    (folder / "02876657" / "round").symlink_to(folder, target_is_directory=True)
    (folder / "02876657" / "self").symlink_to(folder / "02876657" / "self")
    (folder / "02876657" / "twice").symlink_to(folder / "02876657" / "a1", target_is_directory=True)
    (folder / "out").symlink_to(other, target_is_directory=True)
    (other / "deep" / "back").symlink_to(folder, target_is_directory=True)
    assert meshes(folder, True) == sorted([*before, "out/deep/f.off"])
    # A link to nothing is named like the others, so that reading it says what is wrong.
    (folder / "broken.obj").symlink_to(tmp_path / "nowhere.obj")
    assert meshes(folder, False) == ["broken.obj", "top.stl"]


def test_the_hint_counts_the_meshes_below(folder, tmp_path, monkeypatch):
    assert (
        subfolder_hint("f()", folder)
        == "has 3 meshes in subfolders, which are not used; add --recursive, or recursive=True"
    )
    assert subfolder_hint("f()", folder / "02876657" / "a1") == HINT
    assert subfolder_hint("f()", folder / "02876657" / "b2") == ""
    with pytest.warns(TdfWarning, match=r"f\(\): .*meshes has 3 meshes in subfolders, .*; add --recursive, or"):
        warn_of_subfolders("f()", folder)
    monkeypatch.setattr(mesh_folder, "MOST_FOLDERS", 3)  # the search of a whole disk ends too
    assert subfolder_hint("f()", folder) == HINT.replace("1", "at least 1")


def test_a_folder_that_cannot_be_read_is_named(folder, monkeypatch):
    scan = os.scandir

    def refusing(path):
        if str(path).endswith("b2"):
            raise PermissionError(13, "Permission denied")
        return scan(path)

    monkeypatch.setattr(os, "scandir", refusing)
    with pytest.raises(InputError, match=r"f\(\): cannot read the folder .*b2 \(Permission denied\); expected"):
        file_names("f()", folder, True)
    assert subfolder_hint("f()", folder).startswith("has 1 mesh in subfolders")  # of those that can be read before it
