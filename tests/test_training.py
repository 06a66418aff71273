"""Training data and its labels, the batches drawn from it, and the loop: it learns, and resumes exactly."""

import dataclasses
import functools
import json

import jax
import numpy as np
import pytest
from scipy.spatial import cKDTree

from tdf_jax.errors import InputError
from tdf_jax.network import NetworkConfig, parameter_shapes
from tdf_jax.pointcloud import sample_surface
from tdf_jax.shapes import build_mug, sample_mug
from tdf_jax.training import data, loop
from tdf_jax.training.data import BOX_PADDING, DIAGONALS, draw, generate

NETWORK = NetworkConfig(latent=16, vector_hidden=16, vector_width=32, decoder_width=16, blocks=1)
CONFIG = loop.TrainConfig(
    seed=3,
    steps=40,
    batch=2,
    points=32,
    queries=64,
    objects=2,
    validation=1,
    learning_rate=0.02,
    warmup=2,
    validate_every=20,
    save_seconds=0.0,
    network=NETWORK,
)


@pytest.fixture(scope="module")
def objects():
    return generate(seed=5, objects=2, points=400, queries=1000, progress=False)


@pytest.fixture(scope="module")
def train(quick_compilation):
    """`loop.train` on small clouds. An optimiser is part of the step's cache key: kept, all tests compile it once."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(loop, "_optimiser", functools.cache(loop._optimiser))
        patch.setattr(data, "SPARSE_CLOUDS", (40, 300))
        patch.setattr(loop.training_data, "generate", functools.partial(generate, points=300, queries=400))
        yield functools.partial(loop.train, progress=False)


@pytest.fixture(scope="module")
def whole(train, tmp_path_factory):
    """An uninterrupted run: its folder, and the network's parameters."""
    folder = tmp_path_factory.mktemp("whole")
    return folder, train(CONFIG, folder)


def metrics(directory):
    rows = [json.loads(line) for line in (directory / "metrics.jsonl").read_text().splitlines()]
    return [{name: value for name, value in row.items() if name != "seconds"} for row in rows]


# ---- data ----


def test_data_are_a_function_of_the_seed(objects):
    again = generate(seed=5, objects=1, points=400, queries=1000, progress=False)
    other = generate(seed=6, objects=1, points=400, queries=1000, progress=False)
    for name in ("surface", "queries", "inside", "diagonals"):
        first, once_more, different = (getattr(these, name)[0] for these in (objects, again, other))
        np.testing.assert_array_equal(once_more, first)
        assert np.mean(first != different) > 0.05
    shapes = [array.shape for array in (objects.surface, objects.queries, objects.inside, objects.diagonals)]
    assert shapes == [(2, 400, 3), (2, 1000, 3), (2, 1000), (2,)]


def winding_numbers(mesh, points):
    """How often a closed mesh winds around each point, 1 inside, 0 outside, by Van Oosterom's solid angles."""
    corners = mesh.vertices[mesh.faces][None] - points[:, None, None]
    a, b, c = np.moveaxis(corners, 2, 0)
    A, B, C = (np.linalg.norm(corner, axis=-1) for corner in (a, b, c))
    volume = np.einsum("pfi,pfi->pf", a, np.cross(b, c))
    spread = A * B * C + (a * b).sum(-1) * C + (b * c).sum(-1) * A + (c * a).sum(-1) * B
    return 2 * np.arctan2(volume, spread).sum(axis=1) / (4 * np.pi)


def test_labels_and_surfaces_are_those_of_the_mesh(objects):
    mesh = build_mug(sample_mug(np.random.default_rng([5, 0]))).mesh
    diagonal = objects.diagonals[0]
    np.testing.assert_allclose(diagonal, np.linalg.norm(mesh.extents), rtol=1e-6)
    chosen = np.r_[:120, 500:620]  # uniform ones, and some near the surface
    inside, x = objects.inside[0, chosen], objects.queries[0, chosen] * diagonal
    assert 20 < inside.sum() < len(inside) - 20
    np.testing.assert_array_equal(np.round(winding_numbers(mesh, x)), inside)
    dense = cKDTree(sample_surface(mesh, 50_000, np.random.default_rng(0)))
    assert dense.query(objects.surface[0] * diagonal)[0].max() < 0.01 * diagonal


def test_the_first_half_of_the_queries_is_uniform_in_the_padded_box(objects):
    mesh = build_mug(sample_mug(np.random.default_rng([5, 0]))).mesh
    low, high = mesh.bounds / objects.diagonals[0]
    relative = (objects.queries[0, objects.uniform] - low + BOX_PADDING) / (high - low + 2 * BOX_PADDING)
    assert objects.uniform == slice(0, 500)
    assert (relative > -1e-5).all() and (relative < 1 + 1e-5).all()
    np.testing.assert_allclose(relative.mean(axis=0), 0.5, atol=0.06)  # 4.6 standard deviations of the mean
    np.testing.assert_allclose(relative.std(axis=0), np.sqrt(1 / 12), atol=0.03)


def test_batches_are_a_function_of_the_generator(objects, monkeypatch):
    monkeypatch.setattr(data, "SPARSE_CLOUDS", (40, 300))
    first, again, other = (draw(objects, np.random.default_rng(seed), 3, 32, 50, 0.5) for seed in (0, 0, 1))
    for field in dataclasses.fields(first):
        np.testing.assert_array_equal(getattr(first, field.name), getattr(again, field.name))
    assert not np.array_equal(first.clouds, other.clouds)
    assert first.clouds.shape == (3, 32, 3) and first.queries.shape == (3, 50, 3) and first.inside.shape == (3, 50)
    assert {array.dtype for array in (first.clouds, first.queries, first.inside)} == {np.dtype("float32")}


def test_batches_are_centred_and_scaled_together_with_their_queries(objects, monkeypatch):
    """Query points, shrunk back to the object, are labelled as in the data."""
    monkeypatch.setattr(data, "SPARSE_CLOUDS", (300, 300))
    batch = draw(objects, np.random.default_rng(0), 4, 300, 50, 0.0)
    np.testing.assert_allclose(batch.clouds.mean(axis=1), 0, atol=1e-7)
    sizes = np.linalg.norm(np.ptp(batch.clouds, axis=1), axis=-1)
    assert (sizes > 0.9 * DIAGONALS[0]).all() and (sizes < DIAGONALS[1]).all() and np.ptp(sizes) > 0.01
    for cloud, queries, inside in zip(batch.clouds, batch.queries, batch.inside):
        found = []
        for surface, x, labels in zip(objects.surface, objects.queries, objects.inside):
            # Unit and origin from the extents of the cloud, which 300 of the 400 surface points give to some per cent.
            scale = np.ptp(cloud, axis=0).max() / np.ptp(surface, axis=0).max()
            place = queries / scale + surface.mean(axis=0)
            nearest = np.linalg.norm(place[:, None] - x, axis=-1).argmin(axis=1)
            found.append(np.mean(labels[nearest] == inside))
        assert max(found) > 0.9


# ---- the loop ----


def test_training_lowers_the_loss(whole):
    folder, params = whole
    rows = metrics(folder)
    assert [row["step"] for row in rows] == list(range(1, 41))
    losses = [row["loss"] for row in rows]
    assert np.mean(losses[-5:]) < 0.8 * np.mean(losses[:5])
    assert [row["step"] for row in rows if "validation" in row] == [20, 40]
    assert set(rows[-1]["validation"]) == {"loss", "bce", "frame", "iou"}
    shapes = {".".join(key.key for key in path): leaf.shape for path, leaf in jax.tree.leaves_with_path(params)}
    assert shapes == dict(parameter_shapes(NETWORK))


def assert_same(found, expected):
    for a, b in zip(jax.tree.leaves(found), jax.tree.leaves(expected), strict=True):
        np.testing.assert_array_equal(a, b)


def test_a_killed_run_resumes_to_the_same_numbers(train, whole, tmp_path, monkeypatch):
    """Killed after the step that follows a checkpoint: that step is taken again, and its first line of metrics goes."""
    save = loop._save

    def killed_at_5(directory, params, state, step):
        if step == 5:
            raise KeyboardInterrupt
        save(directory, params, state, step)

    monkeypatch.setattr(loop, "_save", killed_at_5)
    with pytest.raises(KeyboardInterrupt):
        train(CONFIG, tmp_path)
    assert [row["step"] for row in metrics(tmp_path)] == [1, 2, 3, 4, 5]
    monkeypatch.setattr(loop, "_save", save)
    resumed = train(CONFIG, tmp_path)
    folder, params = whole
    assert metrics(tmp_path) == metrics(folder)
    assert_same(resumed, params)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["config.json", "metrics.jsonl", "state.msgpack"]


def test_a_finished_run_gives_what_it_gave(train, whole):
    folder, params = whole
    before = metrics(folder)
    assert_same(train(CONFIG, folder), params)
    assert metrics(folder) == before


def test_other_settings_are_refused(train, tmp_path):
    (tmp_path / "config.json").write_text(json.dumps(dataclasses.asdict(CONFIG)))
    others = {"seed": 4, "batch": 3, "network": dataclasses.replace(NETWORK, latent=8)}
    for name, value in others.items():
        with pytest.raises(InputError, match=rf"train\(\): .* holds a run with other settings \({name}\)"):
            train(dataclasses.replace(CONFIG, **{name: value}), tmp_path)
    assert json.loads((tmp_path / "config.json").read_text()) == dataclasses.asdict(CONFIG)
    assert [path.name for path in tmp_path.iterdir()] == ["config.json"]


def test_a_loss_that_is_not_finite_stops_the_run(train, tmp_path, monkeypatch):
    monkeypatch.setattr(loop, "summary", lambda parts: {"loss": np.nan, "bce": 0.0, "frame": 0.0, "iou": 0.0})
    with pytest.raises(FloatingPointError, match="the loss is nan at step 1; lower the learning rate"):
        train(CONFIG, tmp_path)
    assert not (tmp_path / "state.msgpack").exists()


def test_metrics_cut_short_anywhere_are_dropped(tmp_path):
    """A kill cuts the last line at any byte, also between the two closing braces of a row with a validation."""
    whole, row = '{"step": 1, "loss": 2.0}', '{"step": 2, "loss": 1.0, "validation": {"iou": 0.5}}'
    for cut in range(1, len(row)):
        path = tmp_path / "metrics.jsonl"
        path.write_text(whole + "\n" + row[:cut])
        loop._drop_later_metrics(path, 2)
        assert path.read_text() == whole + "\n"


@pytest.mark.parametrize(
    "bad",
    [{"steps": 0}, {"steps": 30}, {"batch": 0}, {"points": 20}, {"points": 2001}, {"queries": 0}, {"objects": 0}, {"seed": -1}]
    + [{"learning_rate": float("nan")}, {"sparse": 1.5}, {"save_seconds": -1.0}, {"validate_every": 0}],
)
def test_bad_settings_are_refused_before_any_work(bad):
    with pytest.raises(InputError, match=f"{next(iter(bad))} is"):
        loop.TrainConfig(**bad)


def test_a_damaged_run_is_refused(tmp_path):
    (tmp_path / "config.json").write_text("{")
    with pytest.raises(InputError, match="config.json cannot be read"):
        loop._claim(loop.TrainConfig(), tmp_path)
    (tmp_path / "state.msgpack").write_bytes(b"\x93\x01")
    with pytest.raises(InputError, match="state.msgpack cannot be read"):
        loop._restore(tmp_path, {}, {})
