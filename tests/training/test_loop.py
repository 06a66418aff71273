"""The loop of training: it learns, resumes exactly, and refuses what it cannot go on from."""

import dataclasses
import functools
import json
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from tdf_jax._internal.errors import InputError
from tdf_jax.networks.occupancy import NetworkConfig, parameter_shapes
from tdf_jax.solvers.adam import OptimizeConfig
from tdf_jax.training import dataset, loop, run_folder
from tdf_jax.training.config import TrainConfig
from tdf_jax.training.dataset import Recipe, joined
from tdf_jax.training.objective import FRONT, UP, frame_error
from tdf_jax.viz.training import training_figure

NETWORK = NetworkConfig(latent=16, vector_hidden=16, vector_width=32, decoder_width=16, blocks=1)
CONFIG = TrainConfig(
    seed=3,
    steps=8,
    batch=2,
    points=32,
    queries=64,
    box=8,
    num_poses=3,
    learning_rate=0.02,
    warmup=2,
    validate_every=4,
    save_seconds=0.0,
    network=NETWORK,
)
LONG = dataclasses.replace(CONFIG, steps=40, validate_every=20)  # enough to learn something


def built(folder, category="mug", objects=2):
    recipe = Recipe(seed=3, objects=objects, validation=2, points=400, queries=400, cameras=4, category=category)
    dataset.build(recipe, folder, progress=False)
    return dataset.load(folder)


@pytest.fixture(scope="module")
def sets(tmp_path_factory):
    """Training and validation objects."""
    return built(tmp_path_factory.mktemp("sets"))


@pytest.fixture(scope="module")
def two_sets(sets, tmp_path_factory):
    """Of mugs and of bowls that are all round, joined."""
    bowls = [
        dataclasses.replace(part, fold=np.zeros_like(part.fold))
        for part in built(tmp_path_factory.mktemp("bowls"), "bowl", objects=3)
    ]
    return tuple(joined(pair) for pair in zip(sets, bowls, strict=True))


@pytest.fixture(scope="module")
def train(sets, quick_compilation):
    """`loop.train` on small clouds. An optimiser is part of the step's cache key: kept, all tests compile it once."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(loop, "_optimiser", functools.cache(loop._optimiser))
        patch.setattr(loop, "TRANSFER", OptimizeConfig(num_starts=2, iterations=2))
        patch.setattr(loop, "VALIDATION_BOX", 8)
        patch.setattr(loop, "VALIDATION_POSES", 5)
        patch.setattr("tdf_jax.training.batch.SPARSE_POINTS", (40, 300))
        # half a metre is too much for so small a network
        patch.setattr("tdf_jax.training.batch.DIAGONALS", (0.12, 0.25))
        yield lambda config, directory, data=sets, **options: loop.train(
            config, *data, directory, progress=False, **options
        )


@pytest.fixture(scope="module")
def whole(train, tmp_path_factory):
    """An uninterrupted run: its folder, and the network's parameters."""
    folder = tmp_path_factory.mktemp("whole")
    return folder, train(CONFIG, folder)


@pytest.fixture(scope="module")
def long(train, tmp_path_factory):
    folder = tmp_path_factory.mktemp("long")
    return folder, train(LONG, folder)


def metrics(directory):
    rows = [json.loads(line) for line in (directory / "metrics.jsonl").read_text().splitlines()]
    return [{name: value for name, value in row.items() if name != "seconds"} for row in rows]


@pytest.mark.slow
def test_training_lowers_the_loss(long):
    rows = metrics(long[0])
    assert [row["step"] for row in rows] == list(range(1, 41))
    losses = [row["bce"] + row["frame"] for row in rows]
    # By the half of the run: partial clouds, which grow from then on, are too much for a network this small.
    assert np.mean(losses[14:19]) < 0.8 * np.mean(losses[:4])


def test_every_step_is_recorded_and_some_are_validated(whole):
    folder, params = whole
    rows = metrics(folder)
    assert [row["step"] for row in rows] == list(range(1, 9))
    assert rows[-1]["frame"] < rows[0]["frame"]
    assert [row["step"] for row in rows if "validation" in row] == [4, 8]
    for name in ("validation", "one_view"):
        assert set(rows[-1][name]) == {"loss", "bce", "frame", "place", "iou"}
    assert rows[-1]["validation"] != rows[-1]["one_view"]
    assert set(rows[-1]["transfer"]) == {"position_cm", "rotation_deg", "success"}
    shapes = {".".join(key.key for key in path): leaf.shape for path, leaf in jax.tree.leaves_with_path(params)}
    assert shapes == dict(parameter_shapes(NETWORK))


@pytest.mark.slow
def test_a_run_gives_the_average_over_its_latest_steps(train, tmp_path, monkeypatch):
    taken, step = [], loop._step

    def noted(*arguments):
        result = step(*arguments)
        taken.append(jax.tree.map(np.asarray, result[0]["network"]))
        return result

    monkeypatch.setattr(loop, "_step", noted)
    given = train(dataclasses.replace(CONFIG, steps=12), tmp_path)
    weights = np.zeros(12)
    for index in range(12):
        weights *= 1 - 10 / (10 + index)
        weights[index] = 10 / (10 + index)
    expected = jax.tree.map(lambda *leaves: np.tensordot(weights, np.stack(leaves), 1), *taken)
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, atol=1e-6), given, expected)
    # Over a tenth of the run: the mean age of what is averaged is an eleventh of the last step's number.
    np.testing.assert_allclose(weights @ (11 - np.arange(12)), 11 / 11, rtol=1e-12)


def assert_same(found, expected):
    for a, b in zip(jax.tree.leaves(found), jax.tree.leaves(expected), strict=True):
        np.testing.assert_array_equal(a, b)


def test_a_killed_run_resumes_to_the_same_numbers(train, whole, tmp_path, monkeypatch):
    """Killed after the step that follows a checkpoint: that step is taken again, and its first line of metrics goes."""
    save = loop.save

    def killed_at_5(directory, params, state, step):
        if step == 5:
            raise KeyboardInterrupt
        save(directory, params, state, step)

    monkeypatch.setattr(loop, "save", killed_at_5)
    with pytest.raises(KeyboardInterrupt):
        train(CONFIG, tmp_path)
    assert [row["step"] for row in metrics(tmp_path)] == [1, 2, 3, 4, 5]
    monkeypatch.setattr(loop, "save", save)
    resumed = train(CONFIG, tmp_path)
    folder, params = whole
    assert metrics(tmp_path) == metrics(folder)
    assert_same(resumed, params)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["config.json", "metrics.jsonl", "state.msgpack"]


@pytest.mark.slow
def test_a_network_of_two_data_sets_trains_and_resumes_to_the_same_numbers(train, two_sets, tmp_path, monkeypatch):
    """Killed at its fifth step and begun again; validation is on pairs of mugs and pairs of bowls, never of both."""
    params = train(CONFIG, tmp_path / "whole", data=two_sets)
    rows = metrics(tmp_path / "whole")
    assert [row["step"] for row in rows if "validation" in row] == [4, 8]
    assert set(rows[-1]["validation"]) == {"loss", "bce", "frame", "place", "iou"}
    assert set(rows[-1]["transfer"]) == {"position_cm", "rotation_deg", "success"}
    save, kill = loop.save, [5]

    def killed(directory, params, state, step):
        if [step] == kill:
            raise KeyboardInterrupt
        save(directory, params, state, step)

    monkeypatch.setattr(loop, "save", killed)
    with pytest.raises(KeyboardInterrupt):
        train(CONFIG, tmp_path / "cut", data=two_sets)
    kill.clear()
    resumed = train(CONFIG, tmp_path / "cut", data=two_sets)
    assert metrics(tmp_path / "cut") == rows
    assert_same(resumed, params)
    with pytest.raises(InputError, match=r"other settings \(data\)"):
        train(CONFIG, tmp_path / "cut")


def test_a_finished_run_gives_what_it_gave(train, whole):
    folder, params = whole
    before = metrics(folder)
    assert_same(train(CONFIG, folder), params)
    assert metrics(folder) == before


def test_other_settings_are_refused(train, sets, whole, tmp_path):
    settings = (whole[0] / "config.json").read_text()
    (tmp_path / "config.json").write_text(settings)
    others = {"seed": 4, "batch": 4, "network": dataclasses.replace(NETWORK, latent=8)}
    for name, value in others.items():
        with pytest.raises(InputError, match=rf"train\(\): .* holds a run with other settings \({name}\)"):
            train(dataclasses.replace(CONFIG, **{name: value}), tmp_path)
    with pytest.raises(InputError, match=r"other settings \(initial\)"):
        train(CONFIG, tmp_path, initial=whole[1])
    with pytest.raises(InputError, match=r"other settings \(data\)"):
        loop.train(CONFIG, sets[1], sets[1], tmp_path, progress=False)
    assert (tmp_path / "config.json").read_text() == settings
    assert [path.name for path in tmp_path.iterdir()] == ["config.json"]


def test_data_with_too_few_points_are_refused(train, tmp_path):
    with pytest.raises(InputError, match=r"points is 350, but a camera sees \d+ of an object's 400 surface points"):
        train(dataclasses.replace(CONFIG, points=350), tmp_path)
    assert not list(tmp_path.iterdir())


def test_a_loss_that_is_not_finite_stops_the_run(train, tmp_path, monkeypatch):
    monkeypatch.setattr(
        loop, "summary", lambda parts: {"loss": np.nan, "bce": 0.0, "frame": 0.0, "place": 0.0, "iou": 0.0}
    )
    with pytest.raises(FloatingPointError, match="the loss is nan at step 1; lower the learning rate"):
        train(CONFIG, tmp_path)
    assert not (tmp_path / "state.msgpack").exists()


def test_metrics_cut_short_anywhere_are_dropped(tmp_path):
    """A kill cuts the last line at any byte, also between the two closing braces of a row with a validation."""
    whole, row = '{"step": 1, "loss": 2.0}', '{"step": 2, "loss": 1.0, "validation": {"iou": 0.5}}'
    for cut in range(1, len(row)):
        (tmp_path / "metrics.jsonl").write_text(whole + "\n" + row[:cut])
        run_folder.drop_later_metrics(tmp_path, 2)
        assert (tmp_path / "metrics.jsonl").read_text() == whole + "\n"


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="needs a device that is always full")
def test_metrics_on_a_full_disk_are_refused_by_name(tmp_path):
    run_folder.add_metrics(tmp_path, {"step": 1})
    assert run_folder.metrics(tmp_path) == [{"step": 1}]
    (tmp_path / "metrics.jsonl").unlink()
    (tmp_path / "metrics.jsonl").symlink_to("/dev/full")
    message = r"^train\(\): cannot write .*metrics.jsonl \(No space left on device\).* run again to resume$"
    with pytest.raises(InputError, match=message):
        run_folder.add_metrics(tmp_path, {"step": 2})


@pytest.mark.slow
def test_a_run_may_go_on_from_weights(train, long, tmp_path):
    """It starts where the weights left off, with its frame read out again, not from the beginning."""
    before = jax.tree.map(np.array, long[1])
    train(dataclasses.replace(LONG, steps=4, corruption=0.0), tmp_path, initial=long[1])
    assert_same(long[1], before)  # still there, and as they were
    first, fresh = metrics(tmp_path)[0], metrics(long[0])[0]  # of the same objects
    # 40 steps of so small a network amplify rounding: with sums in another order the first ratio was 0.98 instead of
    # 0.94, the second 0.004 for 0.04.
    assert first["bce"] < fresh["bce"]
    assert first["frame"] < 0.3 * fresh["frame"]


@pytest.mark.slow
def test_clouds_are_as_sensors_give_them_from_the_first_step_of_a_run_that_goes_on(train, whole, tmp_path, monkeypatch):
    asked, drawn = [], loop.draw
    monkeypatch.setattr(loop, "draw", lambda *arguments: (asked.append(arguments[5]), drawn(*arguments))[1])
    short = dataclasses.replace(CONFIG, steps=4, corruption=0.5)
    train(short, tmp_path / "on", initial=whole[1])
    assert asked[1:] == [0.5] * 5  # the first draw reads the frame out; one batch more than steps is drawn ahead
    asked.clear()
    train(short, tmp_path / "fresh")
    assert asked[1] == 0.0 and asked[4] == 0.5


@pytest.mark.slow
def test_minutes_become_steps(sets, monkeypatch):
    clock = iter(np.arange(0, 1000, 0.5))
    monkeypatch.setattr(loop.time, "monotonic", lambda: next(clock))
    monkeypatch.setattr(loop, "_step", lambda params, state, *_: (params, state, None))
    # 0.5 s a step by that clock, nine tenths of the time
    assert loop.steps_within(10, CONFIG, sets[0], 1) == loop.steps_within(10, CONFIG, sets[0]) == 1080
    with pytest.raises(
        InputError, match=r"0.01 minutes are sufficient for 1 steps of 0.50 s; expected time for more than 2"
    ):
        loop.steps_within(0.01, CONFIG, sets[0])


def test_curves_show_training_and_both_validations():
    """Of canned rows: 40 steps, each tenth validated."""
    rng = np.random.default_rng(0)

    def numbers(*names):
        return dict(zip(names, rng.uniform(0.1, 1, len(names)).tolist(), strict=True))

    rows = [{"step": step, **numbers("bce", "iou", "frame", "place")} for step in range(1, 41)]
    for row in rows[19::20]:
        row |= {name: numbers("bce", "iou", "frame", "place") for name in ("validation", "one_view")}
        row["transfer"] = numbers("success")
    panels = training_figure(rows).axes
    assert len(panels) == 4
    for panel, name in zip(panels, ("bce", "iou", "frame", "place")):
        training, full, view, *others = panel.lines
        np.testing.assert_allclose(training.get_ydata()[-1], np.mean([row[name] for row in rows[-4:]]), rtol=1e-6)
        assert list(full.get_xdata()) == [20, 40]
        np.testing.assert_allclose(full.get_ydata(), [row["validation"][name] for row in rows if "validation" in row])
        np.testing.assert_allclose(view.get_ydata(), [row["one_view"][name] for row in rows if "one_view" in row])
        assert len(others) == (name == "iou")
        for line in others:
            np.testing.assert_allclose(
                line.get_ydata(), [row["transfer"]["success"] for row in rows if "transfer" in row]
            )


def test_transfers_of_validation_objects_have_their_truth(sets):
    """An object laid on itself by its place's truth is itself again."""
    validation = dataclasses.replace(
        sets[1], **{f.name: getattr(sets[1], f.name)[[0, 0]] for f in dataclasses.fields(sets[1])}
    )
    (transfer,) = loop._transfers(validation)
    T = transfer.T_world_place_b @ np.linalg.inv(transfer.T_world_place_a)
    np.testing.assert_allclose(transfer.points_a @ T[:3, :3].T + T[:3, 3], transfer.points_b, atol=1e-5)
    assert np.abs(T - np.eye(4)).max() > 0.1
    np.testing.assert_allclose(np.linalg.norm(np.ptp(transfer.points_a, axis=0)), loop.VALIDATION_DIAGONAL, rtol=0.05)


# ---- symmetric objects ----


errors = jax.jit(jax.value_and_grad(frame_error))
TURNS = {0: (), 1: (0,), 2: (0, 180), 4: (0, 90, 180, 270)}  # degrees between the fronts of an object of each symmetry


@pytest.mark.parametrize("fold", TURNS)
def test_the_frames_error_asks_for_up_and_origin_and_for_the_nearest_front(fold):
    for seed in range(6):
        rng = np.random.default_rng(seed)
        params = {"frame": jnp.asarray(rng.normal(size=(16, 3)))}
        latent, centre = jnp.asarray(rng.normal(size=(16, 3))), jnp.asarray(rng.normal(size=3))
        up, front, origin = np.asarray(params["frame"]).T @ np.asarray(latent)
        fronts = [[np.cos(np.radians(turn)), np.sin(np.radians(turn)), 0] for turn in TURNS[fold]]
        expected = np.sum((up - [0, 0, 1]) ** 2) + np.sum((origin - np.asarray(centre)) ** 2)
        expected += min((np.sum((front - one) ** 2) for one in fronts), default=0)
        found, gradient = errors(params, latent, centre, jnp.asarray(float(fold)))
        np.testing.assert_allclose(found, expected, rtol=1e-5)
        asked = np.abs(gradient["frame"]).max(axis=0) > 0
        np.testing.assert_array_equal(asked, [True, fold != 0, True])


def test_the_loss_of_a_pair_asks_each_object_for_its_own_front(whole, sets):
    params = {"network": whole[1], "frame": jnp.asarray(np.random.default_rng(0).normal(size=(16, 3)), jnp.float32)}
    (pair,) = loop.validation_pairs(sets[1], CONFIG.points, loop.VALIDATION_BOX, loop.VALIDATION_POSES, False)
    np.testing.assert_array_equal(pair.fold, [1, 1])
    parts = {}
    for fold in ((1, 1), (1, 0), (0, 1)):
        samples = dataclasses.astuple(dataclasses.replace(pair, fold=np.array(fold, np.float32)))
        parts[fold] = jax.tree.map(np.asarray, loop._evaluate(params, NETWORK, samples))
    for fold, other in (((1, 0), 1), ((0, 1), 0)):
        assert parts[fold]["frame"][other] < parts[1, 1]["frame"][other] - 0.1
        assert parts[fold]["frame"][1 - other] == parts[1, 1]["frame"][1 - other]
        assert parts[fold]["loss"] < parts[1, 1]["loss"]
        for name in ("bce", "place", "intersection", "union"):
            np.testing.assert_array_equal(parts[fold][name], parts[1, 1][name])


def test_the_front_is_read_out_of_the_objects_that_have_one():
    rng = np.random.default_rng(0)
    latents, centres = rng.normal(size=(5, 16, 3)), rng.normal(size=(5, 3))
    truths = [(UP, FRONT, centre) for centre in centres]
    fitted = np.asarray(loop._read_outs(latents, centres, np.ones(5, np.float32), 0))
    for latent, truth in zip(latents, truths, strict=True):  # 15 equations for 16 unknowns
        np.testing.assert_allclose(fitted.T @ latent, truth, atol=1e-4)
    fold = np.array([1, 0, 1, 2, 4], np.float32)
    some = np.asarray(loop._read_outs(latents, centres, fold, 0))
    np.testing.assert_allclose(some[:, [0, 2]], fitted[:, [0, 2]], atol=1e-6)
    for latent in latents[fold == 1]:
        np.testing.assert_allclose(some[:, 1] @ latent, [1, 0, 0], atol=1e-5)
    np.testing.assert_allclose(
        some[:, 1], np.asarray(loop._read_outs(latents[fold == 1], centres[:2], np.ones(2), 0))[:, 1], atol=1e-6
    )


def test_without_an_object_of_one_front_its_read_out_begins_at_random():
    """From zeros, none of several fronts would ever be the nearest."""
    rng = np.random.default_rng(0)
    latents, centres, fold = rng.normal(size=(5, 16, 3)), rng.normal(size=(5, 3)), np.array([0, 2, 2, 4, 0], np.float32)
    every = np.asarray(loop._read_outs(latents, centres, np.ones(5), 0))
    first, again, other = (np.asarray(loop._read_outs(latents, centres, fold, seed)) for seed in (0, 0, 1))
    assert first.dtype == np.float32 and first.shape == (16, 3)
    np.testing.assert_array_equal(first, again)
    np.testing.assert_array_equal(first[:, [0, 2]], every[:, [0, 2]])
    assert np.abs(first[:, 1] - other[:, 1]).max() > 0.01
    fronts = np.einsum("c,oci->oi", first[:, 1], latents)
    assert 0.3 < np.sqrt(np.mean(np.sum(fronts**2, axis=1))) < 3  # about as long as they are asked to be


@pytest.mark.parametrize("fold", [2, 4])
def test_a_run_from_the_beginning_can_learn_a_front_of_objects_that_have_several(sets, fold):
    data = dataclasses.replace(sets[0], fold=np.full_like(sets[0].fold, fold))
    params, _ = loop._start(CONFIG, data, loop._optimiser(CONFIG), None)
    rng = np.random.default_rng(0)
    latent, centre = (jnp.asarray(rng.normal(size=shape), jnp.float32) for shape in ((16, 3), 3))
    gradient = errors({"frame": params["frame"]}, latent, centre, jnp.float32(fold))[1]["frame"]
    assert np.abs(gradient[:, 1]).max() > 1e-3


def test_transfers_are_between_objects_of_a_kind_and_know_the_symmetry(two_sets):
    validation = two_sets[1]
    transfers = loop._transfers(validation)
    assert [transfer.fold for transfer in transfers] == [1, 0]
    for transfer, (a, b) in zip(transfers, ((0, 1), (2, 3)), strict=True):
        size = loop.VALIDATION_DIAGONAL
        np.testing.assert_allclose(transfer.points_a, size * validation.surface[a], atol=1e-6)
        T = transfer.T_world_b
        np.testing.assert_allclose((transfer.points_b - T[:3, 3]) @ T[:3, :3], size * validation.surface[b], atol=1e-6)
        place = validation.places[b, 0].astype(float)
        place[:3, 3] *= size
        np.testing.assert_allclose(np.linalg.inv(T) @ transfer.T_world_place_b, place, atol=1e-6)


def test_validation_objects_without_another_of_their_kind_are_refused(train, sets, tmp_path):
    alone = dataclasses.replace(sets[1], fold=np.array([0, 2], np.int8))
    with pytest.raises(InputError, match="validation"):
        train(CONFIG, tmp_path, data=(sets[0], alone))


@pytest.mark.parametrize(
    "bad",
    [
        {"steps": 0},
        {"steps": 30},
        {"batch": 0},
        {"batch": 3},
        {"points": 20},
        {"points": 2001},
        {"queries": 0},
        {"num_poses": 1},
        {"seed": -1},
    ]
    + [{"learning_rate": float("nan")}, {"corruption": 1.5}, {"save_seconds": -1.0}, {"validate_every": 0}, {"box": 0}],
)
def test_bad_settings_are_refused_before_any_work(bad):
    with pytest.raises(InputError, match=f"{next(iter(bad))} is"):
        TrainConfig(**bad)


def test_a_damaged_run_is_refused(tmp_path):
    (tmp_path / "config.json").write_text("{")
    with pytest.raises(InputError, match="config.json cannot be read"):
        run_folder.claim(tmp_path, {})
    (tmp_path / "state.msgpack").write_bytes(b"\x93\x01")
    with pytest.raises(InputError, match="state.msgpack cannot be read"):
        run_folder.restore(tmp_path, {}, {})


def test_a_checkpoint_of_another_architecture_is_refused(tmp_path):
    run_folder.save(tmp_path, {"kernel": np.zeros((3, 4))}, {}, 7)
    _, _, step = run_folder.restore(tmp_path, {"kernel": np.ones((3, 4))}, {})
    assert step == 7
    with pytest.raises(InputError, match="state.msgpack is a checkpoint of another network"):
        run_folder.restore(tmp_path, {"kernel": np.ones((4, 4))}, {})
