import concurrent.futures
import contextlib
import errno
import fcntl
import os
import re
import threading

import pytest

from tdf_jax._internal import files
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

    with pytest.raises(InputError, match=r"^who: cannot write .*a\.bin .*No space left"):
        replace_file("who", tmp_path / "a.bin", full)
    assert tree(tmp_path) == {}


@pytest.mark.parametrize("place", ["missing/a.bin", "file/a.bin", "folder"])
def test_a_file_that_has_no_place(tmp_path, place):
    (tmp_path / "file").write_bytes(b"")
    (tmp_path / "folder").mkdir()
    before = tree(tmp_path)
    with pytest.raises(InputError, match=r"^who: cannot write .*expected a writable file in an existing folder"):
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


# Killed writers, and others at the same time


@contextlib.contextmanager
def killed(monkeypatch):
    """The block is ended as by SIGKILL: nothing is cleaned up, but the system releases its locks."""
    with monkeypatch.context() as changed, contextlib.suppress(KeyboardInterrupt):
        for name in ("_remove", "_remove_leftover"):
            changed.setattr(files, name, lambda *_: None)
        yield


def kill(*_):
    raise KeyboardInterrupt


def test_a_killed_writer_of_a_file_leaves_nothing_that_the_next_one_does_not_remove(tmp_path, monkeypatch):
    with killed(monkeypatch):
        replace_file("who", tmp_path / "a.bin", kill)
    (left,) = tmp_path.iterdir()
    assert re.fullmatch(r"\.a\.bin\.[0-9a-f]{16}\.unfinished", left.name)
    replace_file("who", tmp_path / "b.bin", b"another")
    assert left.exists()
    replace_file("who", tmp_path / "a.bin", b"new")
    assert tree(tmp_path) == {"a.bin": b"new", "b.bin": b"another"}


def test_a_killed_writer_of_a_folder_leaves_nothing_that_the_next_one_does_not_remove(tmp_path, monkeypatch):
    with killed(monkeypatch), folder(tmp_path / "out") as new:
        (new / "picture.png").write_bytes(b"half")
        replace_file("who", new / "result.json", kill)
    (left,) = tmp_path.iterdir()
    assert left.name.startswith(".out.") and {one.suffix for one in left.iterdir()} == {".png", ".unfinished"}
    with folder(tmp_path / "out") as new:
        assert not left.exists()
        (new / "result.json").write_bytes(b"new")
    assert tree(tmp_path) == {"out": None, "out/result.json": b"new"}


def test_a_leftover_with_other_files_stays_and_does_not_block(tmp_path, monkeypatch):
    with killed(monkeypatch), folder(tmp_path / "out") as new:
        (new / "notes.txt").write_bytes(b"mine")
        raise KeyboardInterrupt
    before = tree(tmp_path)
    with folder(tmp_path / "out") as new:
        (new / "result.json").write_bytes(b"new")
    assert tree(tmp_path) == before | {"out": None, "out/result.json": b"new"}


def test_what_is_named_as_by_the_release_before_does_not_block(tmp_path):
    (tmp_path / f".out.{os.getpid()}").mkdir()
    (tmp_path / f".a.bin.{os.getpid()}").mkdir()
    with folder(tmp_path / "out") as new:
        (new / "result.json").write_bytes(b"new")
    replace_file("who", tmp_path / "a.bin", b"new")
    assert (tmp_path / "out" / "result.json").exists() and (tmp_path / "a.bin").exists()


def test_a_writer_killed_between_two_renames_has_lost_nothing(tmp_path, monkeypatch):
    with folder(tmp_path / "out") as new:
        (new / "result.json").write_bytes(b"old")
    before, rename = tree(tmp_path), os.rename

    def dies(source, target):
        rename(source, target)
        if source == tmp_path / "out":
            raise KeyboardInterrupt

    with killed(monkeypatch), folder(tmp_path / "out") as new:
        (new / "result.json").write_bytes(b"new")
        monkeypatch.setattr(os, "rename", dies)
    monkeypatch.setattr(os, "rename", rename)
    assert not (tmp_path / "out").exists()
    with pytest.raises(InputError, match="bad"), folder(tmp_path / "out"):
        raise InputError("bad")
    assert tree(tmp_path) == before


def test_a_folder_is_put_back_if_the_new_one_cannot_take_its_place(tmp_path, monkeypatch):
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / "result.json").write_bytes(b"old")
    rename, calls = os.rename, []

    def refuses_the_second(source, target):
        calls.append(target)
        if calls.count(tmp_path / "out") == 2 and len(calls) == 3:
            raise PermissionError(errno.EACCES, "Permission denied")
        rename(source, target)

    monkeypatch.setattr(os, "rename", refuses_the_second)
    message = r"^who: cannot write .*out \(Permission denied\); the finished result is in .*out-[0-9a-f]{8}$"
    with pytest.raises(InputError, match=message), folder(tmp_path / "out") as new:
        (new / "result.json").write_bytes(b"new")
    (other,) = tmp_path.glob("out-*")
    assert tree(tmp_path) == {
        "out": None, "out/result.json": b"old", other.name: None, f"{other.name}/result.json": b"new"
    }  # fmt: skip


@pytest.mark.parametrize("name", ["notes.txt", "picture.png/"])
def test_files_that_came_meanwhile_are_not_replaced_and_the_result_is_kept(tmp_path, name):
    with pytest.raises(InputError, match=r"not empty.*; the finished result is in"), folder(tmp_path / "out") as new:
        (new / "result.json").write_bytes(b"new")
        (tmp_path / "out").mkdir()
        (tmp_path / "out" / "result.json").write_bytes(b"old")
        (tmp_path / "out" / name).mkdir() if name.endswith("/") else (tmp_path / "out" / name).write_bytes(b"mine")
    (other,) = tmp_path.glob("out-*")
    assert tree(other) == {"result.json": b"new"}
    assert (tmp_path / "out" / name).exists() and (tmp_path / "out" / "result.json").read_bytes() == b"old"


def test_what_a_living_writer_writes_is_not_removed(tmp_path):
    def outer(file):
        replace_file("who", tmp_path / "a.bin", b"inner")
        file.write(b"outer")

    replace_file("who", tmp_path / "a.bin", outer)
    with folder(tmp_path / "out") as first:
        with folder(tmp_path / "out") as second:
            (second / "result.json").write_bytes(b"second")
        (first / "result.json").write_bytes(b"first")
    assert tree(tmp_path) == {"a.bin": b"outer", "out": None, "out/result.json": b"first"}


def test_many_writers_at_once(tmp_path):
    def write(number):
        content = str(number).encode() * 1000
        replace_file("who", tmp_path / "a.bin", content)
        with folder(tmp_path / "out") as new:
            for name in NAMES:
                (new / name).write_bytes(content)

    with concurrent.futures.ThreadPoolExecutor(8) as pool:
        list(pool.map(write, range(80)))
    assert set(tree(tmp_path)) == {"a.bin", "out", "out/result.json", "out/picture.png"}
    wholes = {str(number).encode() * 1000 for number in range(80)}
    assert (tmp_path / "a.bin").read_bytes() in wholes
    assert tree(tmp_path / "out")["result.json"] == tree(tmp_path / "out")["picture.png"] in wholes


def test_a_file_taken_for_a_leftover_before_it_is_locked_is_made_again(tmp_path, monkeypatch):
    flock, taken = fcntl.flock, []

    def late(number, operation):
        if len(taken) < 2:
            (path,) = tmp_path.iterdir()
            taken.append(path.name)
            path.unlink()
            if len(taken) == 1:
                raise BlockingIOError(errno.EAGAIN, "held by the other")
        flock(number, operation)

    monkeypatch.setattr(fcntl, "flock", late)
    replace_file("who", tmp_path / "a.bin", b"new")
    assert len(set(taken)) == 2 and tree(tmp_path) == {"a.bin": b"new"}


def test_without_locks_files_are_written_and_leftovers_stay(tmp_path, monkeypatch):
    with killed(monkeypatch):
        replace_file("who", tmp_path / "a.bin", kill)
    before = tree(tmp_path)

    def unsupported(*_):
        raise OSError(errno.ENOLCK, "No locks available")

    monkeypatch.setattr(fcntl, "flock", unsupported)
    replace_file("who", tmp_path / "a.bin", b"new")
    with folder(tmp_path / "out") as new:
        (new / "result.json").write_bytes(b"new")
    assert tree(tmp_path) == before | {"a.bin": b"new", "out": None, "out/result.json": b"new"}


# Kinds of targets


def test_a_file_has_the_mode_of_other_new_files(tmp_path):
    replace_file("who", tmp_path / "a.bin", b"new")
    assert (tmp_path / "a.bin").stat().st_mode & 0o777 == 0o666 & ~_umask()


@pytest.mark.parametrize("name", ["n" * 250, "\u7269" * 80])
def test_a_long_name(tmp_path, name):
    replace_file("who", tmp_path / name, b"new")
    with folder(tmp_path / name[1:]) as new:
        (new / "result.json").write_bytes(b"new")
    assert tree(tmp_path) == {name: b"new", name[1:]: None, f"{name[1:]}/result.json": b"new"}


@pytest.mark.parametrize("existing", [True, False])
def test_the_file_of_a_link_is_replaced_and_not_the_link(tmp_path, existing):
    (tmp_path / "disk").mkdir()
    (tmp_path / "a.bin").symlink_to("disk/b.bin")
    if existing:
        (tmp_path / "disk" / "b.bin").write_bytes(b"old")
    replace_file("who", tmp_path / "a.bin", b"new")
    assert (tmp_path / "a.bin").is_symlink() and (tmp_path / "disk" / "b.bin").read_bytes() == b"new"


def test_a_pipe_or_device_is_written_to_and_stays(tmp_path):
    os.mkfifo(tmp_path / "pipe")
    read = []
    reader = threading.Thread(target=lambda: read.append((tmp_path / "pipe").read_bytes()))
    reader.start()
    replace_file("who", tmp_path / "pipe", b"new")
    reader.join()
    assert read == [b"new"] and (tmp_path / "pipe").is_fifo() and len(list(tmp_path.iterdir())) == 1


@pytest.mark.parametrize("number", [errno.ENOSPC, errno.EINVAL])
def test_a_disk_that_says_that_it_is_full_only_when_it_must_write(tmp_path, monkeypatch, number):
    """As network file systems do; some others do not support fsync."""

    def fails(file):
        raise OSError(number, os.strerror(number))

    (tmp_path / "a.bin").write_bytes(b"old")
    monkeypatch.setattr(os, "fsync", fails)
    if number == errno.EINVAL:
        replace_file("who", tmp_path / "a.bin", b"new")
    else:
        with pytest.raises(InputError, match=r"cannot write .*a\.bin \(No space left on device\)"):
            replace_file("who", tmp_path / "a.bin", b"new")
    assert tree(tmp_path) == {"a.bin": b"new" if number == errno.EINVAL else b"old"}
