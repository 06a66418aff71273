"""Batches drawn ahead: the same and in order, whoever draws them."""

import dataclasses
import errno
import functools
import os
import subprocess
import sys
import tempfile
from pathlib import Path

import numpy as np
import pytest

from tdf_jax._internal.errors import InputError
from tdf_jax.training import dataset, prefetch
from tdf_jax.training.config import TrainConfig
from tdf_jax.training.dataset import Recipe, joined
from tdf_jax.training.loop import batch_of
from tdf_jax.training.prefetch import prefetched

CONFIG = TrainConfig(seed=3, steps=40, batch=2, points=32, queries=16, box=4, num_poses=2)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    folder = tmp_path_factory.mktemp("objects")
    dataset.build(Recipe(seed=3, objects=3, validation=2, points=400, queries=100, cameras=4), folder, progress=False)
    return folder


@pytest.fixture(scope="module")
def data(folder):
    return joined([dataset.load(folder)[0]] * 2)


def who(data, step):
    return os.getpid()


def dying(data, step):
    os._exit(1)


def failing(data, step):
    if step == 2:
        raise ValueError("no batch")
    return step


@pytest.mark.parametrize("workers", [1, pytest.param(2, marks=pytest.mark.slow)])
def test_batches_come_in_the_order_of_steps_and_do_not_depend_on_who_draws_them(data, workers):
    batch = functools.partial(batch_of, CONFIG, gradual=False)
    with prefetched(batch, data, 5, workers) as batches:
        for step in range(5, 5 + 2 * prefetch.PREFETCH * workers + 1):
            for found, expected in zip(
                dataclasses.astuple(next(batches)), dataclasses.astuple(batch(data, step)), strict=True
            ):
                np.testing.assert_array_equal(found, expected)
                assert found.dtype == expected.dtype


@pytest.mark.parametrize("workers", [1, pytest.param(2, marks=pytest.mark.slow)])
def test_what_fails_while_drawing_is_raised_at_its_step(data, workers):
    with prefetched(failing, data, 0, workers) as batches:
        assert [next(batches), next(batches)] == [0, 1]
        with pytest.raises(ValueError, match="no batch"):
            next(batches)


@pytest.mark.parametrize("workers", [1, pytest.param(2, marks=pytest.mark.slow)])
def test_one_worker_is_a_thread_and_several_are_processes(data, workers):
    with prefetched(who, data, 0, workers) as batches:
        drew = {next(batches) for _ in range(20)}
    assert drew == {os.getpid()} if workers == 1 else os.getpid() not in drew and len(drew) <= 2


@pytest.mark.slow
def test_what_processes_draw_from_is_not_left_behind(data, tmp_path, monkeypatch):
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    with prefetched(who, data, 0, 2) as batches:
        next(batches)
        assert len(list(tmp_path.glob("*/*.npy"))) == len(dataclasses.fields(data))
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("number", [errno.ENOSPC, errno.EACCES])
def test_a_full_disk_is_refused_by_name_and_what_a_killed_run_left_is_removed(data, tmp_path, monkeypatch, number):
    def fails(path, array):
        path.write_bytes(b"half")
        raise OSError(number, os.strerror(number))

    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    monkeypatch.setattr(prefetch.np, "save", fails)
    left = tmp_path / ".tdf_train.0123456789abcdef.unfinished"
    left.mkdir()
    (left / "surface.npy").write_bytes(b"half")
    message = rf"cannot write in {tmp_path} \({os.strerror(number)}\).* Set TMPDIR"
    with pytest.raises(InputError, match=message), prefetched(who, data, 0, 2):
        pass
    assert not list(tmp_path.iterdir())


RUN = """
import sys, time
from tdf_jax.training import dataset
from tdf_jax.training.prefetch import prefetched
sys.path.append(sys.argv[1])
from test_prefetch import who

if __name__ == "__main__":
    with prefetched(who, dataset.load(sys.argv[2])[0], 0, 2) as batches:
        print(next(batches), next(batches), flush=True)
        time.sleep(600)
"""


@pytest.mark.slow
def test_a_killed_run_leaves_neither_processes_nor_files(data, folder, tmp_path):
    script, scratch = tmp_path / "run.py", tmp_path / "scratch"
    script.write_text(RUN)
    scratch.mkdir()
    words = [sys.executable, script, Path(__file__).parent, folder]
    with subprocess.Popen(words, stdout=subprocess.PIPE, text=True, env=os.environ | {"TMPDIR": str(scratch)}) as run:
        assert run.stdout.readline() and list(scratch.iterdir())
        run.kill()
        assert run.stdout.read() == ""  # which ends when the last process that could write there has ended
    assert not list(scratch.iterdir())


@pytest.mark.slow
def test_a_process_that_dies_is_named(data):
    with prefetched(dying, data, 0, 2) as batches, pytest.raises(InputError, match="a process that drew samples died"):
        next(batches)


def test_no_workers_are_refused(data):
    with (
        pytest.raises(InputError, match="workers is 0; expected a whole number of at least 1"),
        prefetched(who, data, 0, 0),
    ):
        pass


def test_a_cpu_draws_in_a_thread_and_beside_an_accelerator_every_core_draws(monkeypatch):
    monkeypatch.setattr(prefetch.os, "cpu_count", lambda: 6)
    for on_a_cpu, expected in ((True, 1), (False, 6)):
        monkeypatch.setattr(prefetch, "one_at_a_time", lambda on_a_cpu=on_a_cpu: on_a_cpu)
        assert prefetch.usual_workers() == expected
