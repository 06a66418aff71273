import os

import pytest

from tdf_jax._internal.errors import InputError
from tdf_jax._internal.files import replace_file, replace_folder

NAMES = ("result.json", "picture.png")


def folder(path):
    return replace_folder("who", path, "result.json", NAMES)


def tree(path):
    """Every file below a folder, with its content; empty folders too."""
    return {str(p.relative_to(path)): p.read_bytes() if p.is_file() else None for p in path.rglob("*")}


@pytest.mark.parametrize("content", [b"new", lambda file: file.write(b"new")])
@pytest.mark.parametrize("existing", [None, b"a longer, older content"])
def test_a_file_is_written_or_replaced(tmp_path, content, existing):
    path = tmp_path / "a.bin"
    if existing is not None:
        path.write_bytes(existing)
    replace_file("who", path, content)
    assert tree(tmp_path) == {"a.bin": b"new"}


def test_a_file_that_fails_on_the_way_leaves_the_old_one(tmp_path):
    (tmp_path / "a.bin").write_bytes(b"old")

    def half(file):
        file.write(b"ne")
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        replace_file("who", tmp_path / "a.bin", half)
    assert tree(tmp_path) == {"a.bin": b"old"}


def test_a_full_disk_is_the_users_to_mend(tmp_path):
    def full(file):
        raise OSError(28, "No space left on device")

    with pytest.raises(InputError, match=r"^who\(\): cannot write .*a\.bin .*No space left"):
        replace_file("who", tmp_path / "a.bin", full)
    assert tree(tmp_path) == {}


@pytest.mark.parametrize("place", ["missing/a.bin", "file/a.bin", "folder"])
def test_a_file_that_has_no_place(tmp_path, place):
    (tmp_path / "file").write_bytes(b"")
    (tmp_path / "folder").mkdir()
    before = tree(tmp_path)
    with pytest.raises(InputError, match=r"^who\(\): cannot write .*expected a writable file in an existing folder"):
        replace_file("who", tmp_path / place, b"new")
    assert tree(tmp_path) == before


def test_a_folder_appears_at_the_end(tmp_path):
    with folder(tmp_path / "out") as new:
        (new / "result.json").write_bytes(b"1")
        assert not (tmp_path / "out").exists()
    assert tree(tmp_path) == {"out": None, "out/result.json": b"1"}
    assert (tmp_path / "out").stat().st_mode & 0o777 == 0o777 & ~_umask()


def _umask():
    mask = os.umask(0)
    os.umask(mask)
    return mask


@pytest.mark.parametrize("earlier", [(), ("result.json",), NAMES])
def test_an_earlier_folder_is_replaced_as_a_whole(tmp_path, earlier):
    (tmp_path / "out").mkdir()
    for name in earlier:
        (tmp_path / "out" / name).write_bytes(b"old")
    with folder(tmp_path / "out") as new:
        (new / "result.json").write_bytes(b"new")
    assert tree(tmp_path) == {"out": None, "out/result.json": b"new"}


@pytest.mark.parametrize("error", [InputError("bad"), KeyboardInterrupt(), OSError(28, "No space left on device")])
def test_a_failure_leaves_the_earlier_folder(tmp_path, error):
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / "result.json").write_bytes(b"old")
    before = tree(tmp_path)
    with pytest.raises(InputError if isinstance(error, OSError) else type(error)), folder(tmp_path / "out") as new:
        (new / "result.json").write_bytes(b"new")
        raise error
    assert tree(tmp_path) == before


@pytest.mark.parametrize("others", [("notes.txt",), ("result.json", "notes.txt"), ("picture.png",)])
def test_a_folder_of_the_users_is_never_replaced(tmp_path, others):
    for name in others:
        (tmp_path / name).write_bytes(b"mine")
    before = tree(tmp_path)
    with pytest.raises(InputError, match="not empty"), folder(tmp_path):
        pytest.fail("the work has begun")
    assert tree(tmp_path) == before


@pytest.mark.parametrize(("place", "message"), [
    ("missing/out", "cannot write"), ("file/out", "cannot write"), ("file", "is a file"), (".", "current folder"),
])  # fmt: skip
def test_a_folder_that_has_no_place_is_refused_before_the_work(tmp_path, monkeypatch, place, message):
    (tmp_path / "here").mkdir()
    (tmp_path / "here" / "file").write_bytes(b"")
    monkeypatch.chdir(tmp_path / "here")
    before = tree(tmp_path)
    with pytest.raises(InputError, match=f"^who: .*{message}"), folder(place):
        pytest.fail("the work has begun")
    assert tree(tmp_path) == before


def test_a_folder_that_cannot_be_named_at_the_end_leaves_the_earlier_one(tmp_path, monkeypatch):
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / "result.json").write_bytes(b"old")
    before, rename = tree(tmp_path), os.rename

    def refuses_the_new(source, target):
        if (source / "result.json").read_bytes() == b"new":
            raise PermissionError(13, "Permission denied")
        rename(source, target)

    monkeypatch.setattr(os, "rename", refuses_the_new)
    with pytest.raises(InputError, match="cannot write .*Permission denied"), folder(tmp_path / "out") as new:
        (new / "result.json").write_bytes(b"new")
    assert tree(tmp_path) == before
