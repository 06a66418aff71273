import numpy as np
import pytest

from tdf_jax._internal.cache import digest, kept
from tdf_jax._internal.errors import InputError


def test_what_was_computed_is_read_and_not_computed_again(tmp_path):
    first = kept("who", tmp_path, ["a", 1], lambda: {"x": np.arange(3.0), "y": 2.5})
    again = kept("who", tmp_path, ["a", 1], lambda: pytest.fail("computed again"))
    for found in (first, again):
        assert list(found) == ["x", "y"] and found["y"] == 2.5
        np.testing.assert_array_equal(found["x"], [0, 1, 2])
    assert len(list(tmp_path.iterdir())) == 1


def test_something_else_is_computed_apart(tmp_path):
    for about in (["a", 1], ["a", 2], ["a", [1]], {"a": 1}):
        kept("who", tmp_path, about, lambda about=about: {"x": len(str(about))})
    assert len(list(tmp_path.iterdir())) == 4


def test_a_damaged_file_is_named(tmp_path):
    kept("who", tmp_path, 1, lambda: {"x": 1})
    (path,) = tmp_path.iterdir()
    path.write_bytes(path.read_bytes()[:-30])
    with pytest.raises(InputError, match=rf"^who: .*{path.name} cannot be read .*; delete it"):
        kept("who", tmp_path, 1, lambda: {"x": 1})


def test_what_failed_is_not_kept(tmp_path):
    with pytest.raises(KeyboardInterrupt):
        kept("who", tmp_path, 1, lambda: (_ for _ in ()).throw(KeyboardInterrupt))
    assert not list(tmp_path.iterdir())


def test_digests_stay_because_they_name_files_and_runs(tmp_path):
    kept("who", tmp_path, ["a", {"b": 1}], lambda: {"x": 1})
    assert [path.name for path in tmp_path.iterdir()] == ["8b5348e0de4f9e594240.npz"]
    array = np.arange(6, dtype=np.float32).reshape(2, 3)
    assert (
        digest(array.T, b"more")[:16]
        == digest(np.ascontiguousarray(array.T).tobytes() + b"more")[:16]
        == "a4fbb960b76a6c52"
    )
