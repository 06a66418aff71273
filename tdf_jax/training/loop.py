"""The training loop: deterministic, and resumable with the same numbers."""

import dataclasses
import functools
import time
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import optax
from tqdm.auto import tqdm

from tdf_jax._internal.cache import digest
from tdf_jax._internal.errors import InputError
from tdf_jax.evaluation.cases import Transfer, random_pose
from tdf_jax.evaluation.pick_transfer import place_errors, transferred
from tdf_jax.evaluation.statistics import SUCCESS
from tdf_jax.networks.model import Model, ModelInfo
from tdf_jax.networks.occupancy import encode_latent, initialise
from tdf_jax.solvers.adam import OptimizeConfig
from tdf_jax.training.batch import VALIDATION_DIAGONAL, Batch, draw, validation_pairs
from tdf_jax.training.config import TrainConfig
from tdf_jax.training.dataset import DataSet
from tdf_jax.training.objective import FRONT, UP, mean_gradient, pair_loss
from tdf_jax.training.prefetch import num_prefetched, prefetched
from tdf_jax.training.run_folder import add_metrics, claim, drop_later_metrics, restore, save

CORRUPTION_RISE = (0.1, 0.6)  # shares of the run between which the corruption grows
VALIDATION_BOX, VALIDATION_POSES = 128, 33
TRANSFERS, TRANSFER = 8, OptimizeConfig(num_starts=4, iterations=60)  # fewer than in an evaluation: they show the trend
TIMED_STEPS = 6
AVERAGED = 0.1  # the weights that a run gives are averaged over about this share of its steps, the latest ones


def train(
    config: TrainConfig,
    data: DataSet,
    validation: DataSet,
    directory: str | Path,
    initial: dict | None = None,
    progress: bool = True,
    workers: int = 1,
) -> dict:
    """Train, or resume from the checkpoint in `directory`, up to `config.steps`.

    Every step's batch is a function of the seed and the step, so a resumed run takes the same steps as an uninterrupted
    one.

    Args:
        config: settings of the run.
        data: objects to train on.
        validation: other objects, for validation.
        directory: folder that receives `state.msgpack`, `metrics.jsonl` and `config.json`. A folder with a run of other
            settings, data or initial parameters is refused, except that `steps` may differ.
        initial: parameters of a network to start from, whose sizes are `config.network`; random ones by default. With
            them clouds are corrupted from the first step, because a network that knows one view unlearns it on complete
            clouds (docs/results/code_notes.md).
        progress: whether to show a progress bar.
        workers: number of processes that draw batches, on which the batches do not depend; 1 is a thread of this
            process.

    Returns:
        Parameters of the network, averaged over about the last tenth of the steps. Validation measures these too: at a
        high learning rate they are much better than the latest parameters, so a run can be used at any time.

    Raises:
        InputError: the data have too few points, or the directory holds another run or cannot be written.
        FloatingPointError: the loss is not finite.
    """
    directory = Path(directory)
    seen = int(validation.visible[:, 0].sum(axis=1).min())
    if min(seen, data.surface.shape[1]) < config.points:
        raise InputError(
            f"train(): points is {config.points}, but a camera sees {seen} of an object's {data.surface.shape[1]} "
            "surface points; expected no more than it sees. Lower points, or build the data set with more"
        )
    if not len(validation.pairs()):
        raise InputError(
            "train(): no two validation objects have the same data set and symmetry; expected at least a pair. "
            "Build the data set with more (--validation)"
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
    with prefetched(batch, data, start, workers) as batches:
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
            add_metrics(directory, row)
            if not np.isfinite(row["loss"]):
                raise FloatingPointError(
                    f"train(): the loss is {row['loss']} at step {step + 1}; lower the learning rate"
                )
            if done or time.monotonic() - saved > config.save_seconds:
                save(directory, params, state, step + 1)
                saved = time.monotonic()
    return state["average"]["network"]


def steps_within(minutes: float, config: TrainConfig, data: DataSet, workers: int = 1) -> int:
    """Number of steps that fit into some minutes, from the time of a few steps on this machine.

    Args:
        minutes: minutes of the run, a tenth of which is for validations.
        config: settings of the run.
        data: objects to train on.
        workers: number of processes that draw batches.

    Raises:
        InputError: the time is not sufficient for more steps than `config.warmup`.
    """
    optimiser = _optimiser(config)
    params, state = _start(config, data, optimiser, None)
    times = []
    # These batches are drawn while the first step compiles, so the steps that take them do not wait and are not timed.
    waiting = num_prefetched(workers)
    with prefetched(functools.partial(batch_of, config), data, 0, workers) as batches:
        for step in range(waiting + TIMED_STEPS):
            began = time.monotonic()
            params, state, _ = _step(params, state, dataclasses.astuple(next(batches)), step, config.network, optimiser)
            jax.block_until_ready(params)
            times.append(time.monotonic() - began)
    seconds = float(np.median(times[waiting:]))
    steps = int(0.9 * 60 * minutes / seconds)
    if steps <= config.warmup:
        raise InputError(
            f"train(): {minutes} minutes are sufficient for {steps} steps of {seconds:.2f} s; expected time for more "
            f"than {config.warmup}"
        )
    return steps


def _transfers(validation: DataSet) -> list[Transfer]:
    """Up to `TRANSFERS` tasks: find the first place of a validation object on another of its kind, in a random pose."""
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
    return digest(*jax.tree.leaves(initial))[:16]


def validate(params, config: TrainConfig, pairs: list[Batch]) -> dict:
    """Mean parts of the loss, and IoU on uniform points, of `tdf_jax.training.batch.validation_pairs`."""
    rows = [_evaluate(params, config.network, dataclasses.astuple(pair)) for pair in pairs]
    return summary({name: np.stack([row[name] for row in rows]) for name in rows[0]})


def transfer_errors(params, config: TrainConfig, transfers: list[Transfer]) -> dict:
    """Median errors of the first place on complete clouds, cm and degrees, and the share within 2 cm and 20 degrees."""
    model = Model(params["network"], config.network, ModelInfo("training", "training", config.points))
    found = transferred(model, transfers, config=TRANSFER, progress=False)
    distance, angle = place_errors(found, transfers)
    success = np.mean(SUCCESS.holds(distance, angle))
    values = {"position_cm": 100 * np.median(distance), "rotation_deg": np.median(angle), "success": success}
    return {name: round(float(value), 3) for name, value in values.items()}


def summary(parts: dict) -> dict:
    """Means of the loss parts of several objects, with the mean intersection over union instead of its two parts."""
    parts = {name: np.asarray(value, dtype=float) for name, value in parts.items()}
    iou = parts.pop("intersection") / np.maximum(parts.pop("union"), 1)
    return {name: round(float(value.mean()), 5) for name, value in (parts | {"iou": iou}).items()}


@functools.partial(jax.jit, static_argnames=("config", "optimiser"), donate_argnums=(0, 1))
def _step(params, state, samples, step, config, optimiser):
    gradient, parts = mean_gradient(params, config, *samples)
    updates, optimisation = optimiser.update(gradient, state["optimiser"], params)
    params = optax.apply_updates(params, updates)
    # The weight of the latest parameters falls as 1/step, so the average covers a share of the run and not a number of
    # steps.
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
        # Adam optimises a first layer of 3 channels and a read-out of 1 with the vectors, because they have nothing to
        # orthogonalise.
        muon = optax.contrib.MuonDimensionNumbers()
        return jax.tree.map(lambda leaf: muon if leaf.ndim == 2 and min(leaf.shape) >= 16 else None, params)

    return optax.contrib.muon(
        lambda step: config.learning_rate * schedule(step),
        adam_learning_rate=lambda step: config.learning_rate / 6 * schedule(step),
        muon_weight_dimension_numbers=matrices,
    )


def batch_of(config: TrainConfig, data: DataSet, step: int, gradual: bool = True) -> Batch:
    """The batch of one step: a function of the seed and the step."""
    corruption = config.corruption * (np.interp(step / config.steps, CORRUPTION_RISE, (0, 1)) if gradual else 1)
    rng = np.random.default_rng([config.seed, 1, step])
    return draw(data, rng, config.batch // 2, config.points, config.queries, corruption, config.box, config.num_poses)


def _start(config, data, optimiser, initial):
    samples = draw(data, np.random.default_rng([config.seed, 2]), 4, config.points, 1, 0.0, 1, 1)
    centres = samples.centres.reshape(8, 3) * config.network.scaling
    clouds = samples.clouds.reshape(8, config.points, 3)

    @jax.jit  # without it, every operation is a program to compile, and there are hundreds
    def latents(network):
        return jax.lax.map(lambda cloud: encode_latent(network, config.network, cloud), clouds)

    if initial is None:
        network = initialise(jax.random.key(config.seed), config.network)
        # Mean pooling shrinks the latent. At an rms of 0.5 it influences the decoder from the first step.
        final = network["encoder"]["fc_c"]["map_to_feat"]
        final["kernel"] = final["kernel"] * (0.5 / jnp.sqrt(jnp.mean(latents(network) ** 2)))
        frame = jnp.zeros((config.network.latent, 3))
        if not (data.fold == 1).any():
            frame = frame.at[:, 1].set(_any_front(np.asarray(latents(network)), config.seed))
    else:
        network = jax.tree.map(jnp.array, initial)  # a copy, because the first step donates its arguments
        frame = _read_outs(np.asarray(latents(network)), centres, samples.fold.reshape(8), config.seed)
    params = {"network": network, "frame": frame}
    return params, {"optimiser": optimiser.init(params), "average": jax.tree.map(jnp.copy, params)}


def _read_outs(latents, centres, fold, seed):
    """Read-outs (latent, 3) of the frame that fit latents (objects, latent, 3) best; weight files do not have them."""
    truths = np.stack([np.stack([UP, FRONT, centre], axis=1) for centre in centres])
    known = fold >= 0, fold == 1, fold >= 0
    read = [_fitted(latents[these], truths[these][..., number]) for number, these in enumerate(known)]
    if not (fold == 1).any():
        read[1] = _any_front(latents, seed)
    return jnp.asarray(np.stack(read, axis=1), jnp.float32)


def _any_front(latents, seed):
    """A random read-out (latent,) of vectors of a length of about 1.

    With a read-out of zeros, all fronts of a symmetric object would remain at the same distance.
    """
    scale = np.sqrt(np.mean(np.sum(latents**2, axis=(1, 2))))
    return np.random.default_rng([seed, 3]).normal(size=latents.shape[1]) / scale


def _fitted(latents, truths):
    """The read-out (latent,) of least squares; zeros if there are no latents."""
    if not len(latents):
        return np.zeros(latents.shape[1])
    return np.linalg.lstsq(np.concatenate([latent.T for latent in latents]), truths.reshape(-1))[0]
