"""The training loop: deterministic, and resumable to the same numbers."""

import dataclasses
import functools
import hashlib
import json
import time
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import optax
from tqdm import tqdm

from tdf_jax._internal.errors import InputError
from tdf_jax.evaluation.cases import Transfer, random_pose
from tdf_jax.evaluation.pick_transfer import place_errors, transferred
from tdf_jax.networks.model import Model, ModelInfo
from tdf_jax.networks.occupancy import encode_latent, initialise
from tdf_jax.solvers.adam import OptimizeConfig
from tdf_jax.training.batch import VALIDATION_DIAGONAL, Batch, draw, validation_pairs
from tdf_jax.training.config import TrainConfig
from tdf_jax.training.dataset import DataSet
from tdf_jax.training.objective import FRONT, UP, mean_gradient, pair_loss
from tdf_jax.training.prefetch import asked_ahead, drawn_ahead
from tdf_jax.training.run_folder import METRICS, claim, drop_later_metrics, restore, save

CORRUPTING = (0.1, 0.6)  # shares of the run
VALIDATION_BOX, VALIDATION_POSES = 128, 33
TRANSFERS, TRANSFER = 8, OptimizeConfig(inits=4, iterations=60)  # fewer than an evaluation has: for the trend
TIMED_STEPS = 6
AVERAGED = 0.1  # the weights a run gives are averaged over about this share of its steps, the latest


def train(
    config: TrainConfig,
    data: DataSet,
    validation: DataSet,
    directory: str | Path,
    initial: dict | None = None,
    progress: bool = True,
    workers: int = 1,
) -> dict:
    """Train, or resume where the checkpoint in `directory` stands, to `config.steps`.

    Every step's draw is a function of (seed, step), so a resumed run takes the steps an uninterrupted one would.

    Args:
        config: settings.
        data: the objects to train on.
        validation: others, to measure by.
        directory: receives `state.msgpack`, `metrics.jsonl` and `config.json`. A run that stands there with other
            settings, data or initial parameters is refused, except that `steps` may change.
        initial: parameters of a network to go on from, with `config.network` that of its model; random ones by default.
            Clouds then are as sensors give them from the first step: a network that knew one view unlearned it while
            clouds were complete (IoU 0.48 to 0.08 in 500 steps).
        progress: show a progress bar.
        workers: processes that draw batches, which do not depend on how many there are; 1 is a thread of this one.

    Returns:
        The network's parameters, averaged over about the last tenth of the steps, as validation measures them: at a
        high learning rate they are far better than the latest, so a run's state is of use at any time.

    Raises:
        InputError: the data have too few points, or the directory holds another run or cannot be written.
        FloatingPointError: the loss is no longer finite.
    """
    directory = Path(directory)
    seen = int(validation.visible[:, 0].sum(axis=1).min())
    if min(seen, data.surface.shape[1]) < config.points:
        raise InputError(
            f"train(): points is {config.points}, but a camera sees {seen} of an object's {data.surface.shape[1]} surface points; "
            "expected no more than it sees: lower points, or build the data set with more"
        )
    if not len(validation.pairs()):
        raise InputError(
            "train(): no two validation objects are of one data set and symmetry; expected at least a pair; build the data set with more (--validation)"
        )
    claim(directory, dataclasses.asdict(config) | {"data": data.digest(), "initial": _digest(initial)})
    measured = {
        name: validation_pairs(validation, config.points, VALIDATION_BOX, VALIDATION_POSES, one_view)
        for name, one_view in (("validation", False), ("one_view", True))
    }
    transfers = _transfers(validation)
    optimiser = _optimiser(config)
    params, state, start = restore(directory, *_start(config, data, optimiser, initial))
    drop_later_metrics(directory, start)

    saved = began = time.monotonic()
    batch = functools.partial(batch_of, config, gradual=initial is None)
    with drawn_ahead(batch, data, start, workers) as batches, (directory / METRICS).open("a") as metrics:
        bar = tqdm(range(start, config.steps), initial=start, total=config.steps, desc="training", disable=not progress)
        for step in bar:
            params, state, parts = _step(
                params, state, dataclasses.astuple(next(batches)), step, config.network, optimiser
            )
            row = {"step": step + 1, "seconds": round(time.monotonic() - began, 2)} | summary(parts)
            bar.set_postfix({name: f"{row[name]:.3f}" for name in ("bce", "frame", "place", "iou")})
            done = step + 1 == config.steps
            if done or (step + 1) % config.validate_every == 0:
                row |= {name: validate(state["average"], config, pairs) for name, pairs in measured.items()}
                row["transfer"] = transfer_errors(state["average"], config, transfers)
            metrics.write(json.dumps(row) + "\n")
            metrics.flush()
            if not np.isfinite(row["loss"]):
                raise FloatingPointError(
                    f"train(): the loss is {row['loss']} at step {step + 1}; lower the learning rate"
                )
            if done or time.monotonic() - saved > config.save_seconds:
                save(directory, params, state, step + 1)
                saved = time.monotonic()
    return state["average"]["network"]


def steps_within(minutes: float, config: TrainConfig, data: DataSet, workers: int = 1) -> int:
    """How many steps a run of so many minutes has time for, from the time of a few on this machine.

    Args:
        minutes: for the steps; a tenth is kept for validations.
        config, data, workers: of the run.

    Raises:
        InputError: there is no time for more steps than `config.warmup`.
    """
    optimiser = _optimiser(config)
    params, state = _start(config, data, optimiser, None)
    times = []
    # drawn while the first step compiles: the steps that take them do not wait for samples
    waiting = asked_ahead(workers)
    with drawn_ahead(functools.partial(batch_of, config), data, 0, workers) as batches:
        for step in range(waiting + TIMED_STEPS):
            began = time.monotonic()
            params, state, _ = _step(params, state, dataclasses.astuple(next(batches)), step, config.network, optimiser)
            jax.block_until_ready(params)
            times.append(time.monotonic() - began)
    seconds = float(np.median(times[waiting:]))
    steps = int(0.9 * 60 * minutes / seconds)
    if steps <= config.warmup:
        raise InputError(
            f"train(): {minutes} minutes are enough for {steps} steps of {seconds:.2f} s; expected time for more than {config.warmup}"
        )
    return steps


def _transfers(validation: DataSet) -> list[Transfer]:
    """The first place of one validation object, to be found on another of its kind, turned and moved; at most `TRANSFERS`."""
    transfers = []
    pairs = validation.pairs()
    for index, pair in enumerate(pairs[:: max(1, len(pairs) // TRANSFERS)][:TRANSFERS]):
        T_world_b = random_pose(0, index)
        (points_a, place_a), (points_b, place_b) = (
            (VALIDATION_DIAGONAL * validation.surface[one], _at_size(validation.places[one, 0])) for one in pair
        )
        moved = (points_b @ T_world_b[:3, :3].T + T_world_b[:3, 3]).astype(np.float32)
        transfers.append(
            Transfer(points_a, moved, place_a, T_world_b @ place_b, T_world_b, int(validation.fold[pair[1]]), scale=1.0)
        )
    return transfers


def _at_size(T_object_place):
    T = T_object_place.astype(float)
    T[:3, 3] *= VALIDATION_DIAGONAL
    return T


def _digest(initial):
    if initial is None:
        return None
    return hashlib.sha256(b"".join(np.asarray(leaf).tobytes() for leaf in jax.tree.leaves(initial))).hexdigest()[:16]


def validate(params, config: TrainConfig, pairs: list[Batch]) -> dict:
    """Mean loss parts, and IoU on uniform points, of `tdf_jax.training.batch.validation_pairs`."""
    rows = [_evaluate(params, config.network, dataclasses.astuple(pair)) for pair in pairs]
    return summary({name: np.stack([row[name] for row in rows]) for name in rows[0]})


def transfer_errors(params, config: TrainConfig, transfers: list[Transfer]) -> dict:
    """Median errors, centimetres and degrees, of the first place found on complete clouds, and the share within 2 cm and 20 degrees."""
    model = Model(params["network"], config.network, ModelInfo("training", "training", config.points))
    found = transferred(model, transfers, config=TRANSFER, progress=False)
    distance, angle = place_errors(found, transfers)
    success = np.mean((distance <= 0.02) & (angle <= 20))
    values = {"position_cm": 100 * np.median(distance), "rotation_deg": np.median(angle), "success": success}
    return {name: round(float(value), 3) for name, value in values.items()}


def summary(parts: dict) -> dict:
    """Loss parts of several objects -> their means, with the mean intersection over union in place of its two parts."""
    parts = {name: np.asarray(value, dtype=float) for name, value in parts.items()}
    iou = parts.pop("intersection") / np.maximum(parts.pop("union"), 1)
    return {name: round(float(value.mean()), 5) for name, value in (parts | {"iou": iou}).items()}


@functools.partial(jax.jit, static_argnames=("config", "optimiser"), donate_argnums=(0, 1))
def _step(params, state, samples, step, config, optimiser):
    gradient, parts = mean_gradient(params, config, *samples)
    updates, optimisation = optimiser.update(gradient, state["optimiser"], params)
    params = optax.apply_updates(params, updates)
    # The weight of the latest falls as 1/step, so the average reaches back over a share of the run, not over a number
    # of steps.
    rate = 1 / (1 + AVERAGED * step)
    average = optax.incremental_update(params, state["average"], rate)
    return params, {"optimiser": optimisation, "average": average}, parts


@functools.partial(jax.jit, static_argnames="config")
def _evaluate(params, config, samples):
    loss, parts = pair_loss(params, config, *samples)
    return {"loss": loss, **parts}


def _optimiser(config: TrainConfig) -> optax.GradientTransformation:
    schedule = optax.warmup_cosine_decay_schedule(0.0, 1.0, config.warmup, config.steps, 0.02)

    def matrices(params):
        # A first layer of 3 channels and a read-out of 1 have nothing to orthogonalise: they go to Adam with the
        # vectors.
        muon = optax.contrib.MuonDimensionNumbers()
        return jax.tree.map(lambda leaf: muon if leaf.ndim == 2 and min(leaf.shape) >= 16 else None, params)

    return optax.contrib.muon(
        lambda step: config.learning_rate * schedule(step),
        adam_learning_rate=lambda step: config.learning_rate / 6 * schedule(step),
        muon_weight_dimension_numbers=matrices,
    )


def batch_of(config: TrainConfig, data: DataSet, step: int, gradual: bool = True) -> Batch:
    """The batch of one step: a function of the seed and the step."""
    corruption = config.corruption * (np.interp(step / config.steps, CORRUPTING, (0, 1)) if gradual else 1)
    rng = np.random.default_rng([config.seed, 1, step])
    return draw(data, rng, config.batch // 2, config.points, config.queries, corruption, config.box, config.poses)


def _start(config, data, optimiser, initial):
    samples = draw(data, np.random.default_rng([config.seed, 2]), 4, config.points, 1, 0.0, 1, 1)
    centres = samples.centres.reshape(8, 3) * config.network.scaling
    clouds = samples.clouds.reshape(8, config.points, 3)

    @jax.jit  # whole: operation by operation there are hundreds of programs to compile
    def latents(network):
        return jax.lax.map(lambda cloud: encode_latent(network, config.network, cloud), clouds)

    if initial is None:
        network = initialise(jax.random.key(config.seed), config.network)
        # Mean pooling shrinks the latent; rms 0.5 lets the decoder see it from the first step.
        final = network["encoder"]["fc_c"]["map_to_feat"]
        final["kernel"] = final["kernel"] * (0.5 / jnp.sqrt(jnp.mean(latents(network) ** 2)))
        frame = jnp.zeros((config.network.latent, 3))
        if not (data.fold == 1).any():
            frame = frame.at[:, 1].set(_any_front(np.asarray(latents(network)), config.seed))
    else:
        network = jax.tree.map(jnp.array, initial)  # a copy: the first step takes its arguments over
        frame = _read_outs(np.asarray(latents(network)), centres, samples.fold.reshape(8), config.seed)
    params = {"network": network, "frame": frame}
    return params, {"optimiser": optimiser.init(params), "average": jax.tree.map(jnp.copy, params)}


def _read_outs(latents, centres, fold, seed):
    """The frame's read-outs (latent, 3) that fit latents (objects, latent, 3) best; weights do not carry them."""
    truths = np.stack([np.stack([UP, FRONT, centre], axis=1) for centre in centres])
    known = fold >= 0, fold == 1, fold >= 0
    read = [_fitted(latents[these], truths[these][..., number]) for number, these in enumerate(known)]
    if not (fold == 1).any():
        read[1] = _any_front(latents, seed)
    return jnp.asarray(np.stack(read, axis=1), jnp.float32)


def _any_front(latents, seed):
    """A read-out (latent,) of vectors about 1 long: from zeros, none of a symmetric object's fronts would ever be nearer than another."""
    return np.random.default_rng([seed, 3]).normal(size=latents.shape[1]) / np.sqrt(
        np.mean(np.sum(latents**2, axis=(1, 2)))
    )


def _fitted(latents, truths):
    """The read-out (latent,) of least squares; zeros where there is nothing to fit it to."""
    if not len(latents):
        return np.zeros(latents.shape[1])
    return np.linalg.lstsq(np.concatenate([latent.T for latent in latents]), truths.reshape(-1))[0]
