"""Batches drawn ahead: the same and in order, whoever draws them."""

import dataclasses
import functools

import numpy as np
import pytest

from tdf_jax.training import ahead, dataset
from tdf_jax.training.ahead import drawn_ahead
from tdf_jax.training.config import TrainConfig
from tdf_jax.training.dataset import Recipe, joined
from tdf_jax.training.loop import batch_of

CONFIG = TrainConfig(seed=3, steps=40, batch=2, points=32, queries=16, box=4, poses=2)


@pytest.fixture(scope="module")
def data(tmp_path_factory):
    folder = tmp_path_factory.mktemp("objects")
    dataset.build(Recipe(seed=3, objects=3, validation=2, points=400, queries=100, cameras=4), folder, progress=False)
    return joined([dataset.load(folder)[0]] * 2)


def failing(data, step):
    if step == 2:
        raise ValueError("no batch")
    return step


@pytest.mark.parametrize("workers", [1, 2])
def test_batches_come_in_the_order_of_steps_and_do_not_depend_on_who_draws_them(data, workers):
    batch = functools.partial(batch_of, CONFIG, gradual=False)
    with drawn_ahead(batch, data, 5, workers) as batches:
        for step in range(5, 5 + 2 * ahead.AHEAD * workers + 1):
            for found, expected in zip(dataclasses.astuple(next(batches)), dataclasses.astuple(batch(data, step)), strict=True):
                np.testing.assert_array_equal(found, expected)
                assert found.dtype == expected.dtype


@pytest.mark.parametrize("workers", [1, 2])
def test_what_fails_while_drawing_is_raised_at_its_step(data, workers):
    with drawn_ahead(failing, data, 0, workers) as batches:
        assert [next(batches), next(batches)] == [0, 1]
        with pytest.raises(ValueError, match="no batch"):
            next(batches)


def test_a_cpu_draws_in_a_thread_and_beside_an_accelerator_every_core_draws(monkeypatch):
    monkeypatch.setattr(ahead.os, "cpu_count", lambda: 6)
    assert ahead.usual_workers() == 1
    monkeypatch.setattr(ahead, "one_at_a_time", lambda: False)
    assert ahead.usual_workers() == 6
