"""The training loop: deterministic, resumable from its checkpoint, metrics as JSON lines."""

import concurrent.futures
import dataclasses
import functools
import json
import time
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import optax
from flax import serialization
from tqdm import tqdm

from tdf_jax.errors import InputError
from tdf_jax.files import replace_file
from tdf_jax.network import NetworkConfig, encode_latent, initialise
from tdf_jax.training import data as training_data
from tdf_jax.training.objective import FRAME_AXES, mean_gradient, sample_loss

VALIDATION_SEED = 1_000_003  # added to the run's seed; generated objects are a function of (seed, index)


@dataclasses.dataclass(frozen=True)
class TrainConfig:
    """Settings of one run; the defaults train the shipped mug network.

    Attributes:
        seed: of the initial weights, the objects and every draw.
        steps: optimisation steps; the learning rate falls to 2 % over them (cosine).
        batch: objects a step.
        points: points of a cloud.
        queries: labelled points of an object, a step.
        objects: generated training objects.
        validation: generated validation objects.
        learning_rate: Muon's, on matrices; vectors, biases and the first layer use Adam at a sixth of it.
        warmup: steps of linear rise.
        sparse: share of clouds thinned from few points, reached linearly over the run's second quarter.
        validate_every: steps between validations.
        save_seconds: seconds between checkpoints.
    """

    seed: int = 0
    steps: int = 3000
    batch: int = 8
    points: int = 256
    queries: int = 1536
    objects: int = 1200
    validation: int = 24
    learning_rate: float = 6e-3
    warmup: int = 30
    sparse: float = 0.3
    validate_every: int = 200
    save_seconds: float = 120.0
    network: NetworkConfig = NetworkConfig()

    def __post_init__(self):
        least = dict.fromkeys(("batch", "queries", "objects", "validation", "validate_every"), 1)
        least |= {"seed": 0, "warmup": 0, "steps": self.warmup + 1, "points": self.network.neighbours + 1}
        for name, low in least.items():
            if getattr(self, name) < low:
                raise InputError(f"TrainConfig(): {name} is {getattr(self, name)}; expected at least {low}")
        if self.points > training_data.SPARSE_CLOUDS[1]:
            raise InputError(f"TrainConfig(): points is {self.points}; expected at most {training_data.SPARSE_CLOUDS[1]}")
        if not 0 < self.learning_rate < np.inf:
            raise InputError(f"TrainConfig(): learning_rate is {self.learning_rate}; expected a positive number")
        if not 0 <= self.sparse <= 1:
            raise InputError(f"TrainConfig(): sparse is {self.sparse}; expected a share, 0 to 1")
        if not self.save_seconds >= 0:
            raise InputError(f"TrainConfig(): save_seconds is {self.save_seconds}; expected 0 or more")


def train(config: TrainConfig, directory: str | Path, progress: bool = True) -> dict:
    """Train, or resume where the checkpoint in `directory` stands, to `config.steps`.

    Every step's draw is a function of (seed, step), so a resumed run takes the steps an uninterrupted one would.

    Args:
        config: settings; a checkpoint made with other settings is refused, except that `steps` may change.
        directory: receives `state.msgpack`, `metrics.jsonl` and `config.json`.
        progress: show a progress bar.

    Returns:
        The network's parameters.

    Raises:
        InputError: the directory holds a run with other settings.
    """
    directory = Path(directory)
    directory.mkdir(parents=True, exist_ok=True)
    _claim(config, directory)
    objects = training_data.generate(config.seed, config.objects, progress=progress)
    validation = training_data.generate(config.seed + VALIDATION_SEED, config.validation, progress=progress)
    optimiser = _optimiser(config)
    params, state, start = _restore(directory, *_start(config, objects, optimiser))
    _drop_later_metrics(directory / "metrics.jsonl", start)

    def batch(step):
        ramp = np.clip((4 * step / config.steps) - 1, 0, 1)
        rng = np.random.default_rng([config.seed, 1, step])
        return training_data.draw(objects, rng, config.batch, config.points, config.queries, config.sparse * ramp)

    saved = time.monotonic()
    with concurrent.futures.ThreadPoolExecutor(1) as pool, (directory / "metrics.jsonl").open("a") as metrics:
        upcoming = pool.submit(batch, start)
        bar = tqdm(range(start, config.steps), initial=start, total=config.steps, desc="training", disable=not progress)
        began = time.monotonic()
        for step in bar:
            samples, upcoming = upcoming.result(), pool.submit(batch, step + 1)
            params, state, parts = _step(
                params, state, samples.clouds, samples.queries, samples.inside, config.network, optimiser
            )
            row = {"step": step + 1, "seconds": round(time.monotonic() - began, 2)} | summary(parts)
            bar.set_postfix(bce=f"{row['bce']:.3f}", frame=f"{row['frame']:.3f}", iou=f"{row['iou']:.2f}")
            done = step + 1 == config.steps
            if done or (step + 1) % config.validate_every == 0:
                row["validation"] = validate(params, config, validation)
            metrics.write(json.dumps(row) + "\n")
            if not np.isfinite(row["loss"]):
                raise FloatingPointError(f"train(): the loss is {row['loss']} at step {step + 1}; lower the learning rate")
            if done or time.monotonic() - saved > config.save_seconds:
                metrics.flush()
                _save(directory, params, state, step + 1)
                saved = time.monotonic()
    return params["network"]


def validate(params, config: TrainConfig, validation: training_data.DataSet) -> dict:
    """Mean loss parts and IoU on uniform points, of full clouds at a diagonal of 0.18 m."""
    rows = []
    for index in range(len(validation.surface)):
        cloud = training_data.pointcloud.thin(validation.surface[index], config.points) * 0.18
        origin = cloud.mean(axis=0)
        chosen = validation.uniform
        queries = validation.queries[index, chosen] * 0.18 - origin
        rows.append(_evaluate(params, config.network, cloud - origin, queries, validation.inside[index, chosen] * 1.0))
    return summary({name: np.array([row[name] for row in rows]) for name in rows[0]})


def summary(parts: dict) -> dict:
    """Loss parts of several objects -> their means, with the mean intersection over union in place of its two parts."""
    parts = {name: np.asarray(value, dtype=float) for name, value in parts.items()}
    iou = parts.pop("intersection") / np.maximum(parts.pop("union"), 1)
    return {name: round(float(value.mean()), 5) for name, value in (parts | {"iou": iou}).items()}


@functools.partial(jax.jit, static_argnames=("config", "optimiser"), donate_argnums=(0, 1))
def _step(params, state, clouds, queries, inside, config, optimiser):
    gradient, parts = mean_gradient(params, config, clouds, queries, inside)
    updates, state = optimiser.update(gradient, state, params)
    return optax.apply_updates(params, updates), state, parts


@functools.partial(jax.jit, static_argnames="config")
def _evaluate(params, config, cloud, queries, inside):
    loss, parts = sample_loss(params, config, cloud, queries, inside)
    return {"loss": loss, **parts}


def _optimiser(config: TrainConfig) -> optax.GradientTransformation:
    schedule = optax.warmup_cosine_decay_schedule(0.0, 1.0, config.warmup, config.steps, 0.02)

    def matrices(params):
        # A first layer of 3 channels and a read-out of 1 have nothing to orthogonalise: they go to Adam with the vectors.
        muon = optax.contrib.MuonDimensionNumbers()
        return jax.tree.map(lambda leaf: muon if leaf.ndim == 2 and min(leaf.shape) >= 16 else None, params)

    return optax.contrib.muon(
        lambda step: config.learning_rate * schedule(step),
        adam_learning_rate=lambda step: config.learning_rate / 6 * schedule(step),
        muon_weight_dimension_numbers=matrices,
    )


def _start(config, objects, optimiser):
    params = {
        "network": initialise(jax.random.key(config.seed), config.network),
        "frame": jnp.zeros((config.network.latent, len(FRAME_AXES))),
    }
    # Mean pooling shrinks the latent; rms 0.5 lets the decoder see it from the first step.
    samples = training_data.draw(objects, np.random.default_rng([config.seed, 2]), 8, config.points, 1, 0.0)
    latents = [encode_latent(params["network"], config.network, jnp.asarray(cloud)) for cloud in samples.clouds]
    final = params["network"]["encoder"]["fc_c"]["map_to_feat"]
    final["kernel"] = final["kernel"] * (0.5 / jnp.sqrt(jnp.mean(jnp.stack(latents) ** 2)))
    return params, optimiser.init(params)


def _claim(config, directory):
    settings = dataclasses.asdict(config)
    path = directory / "config.json"
    if path.exists():
        old = _read(path, lambda content: dict(json.loads(content)))
        changed = [name for name in settings if name != "steps" and old.get(name) != settings[name]]
        if changed:
            raise InputError(
                f"train(): {directory} holds a run with other settings ({', '.join(changed)}); expected the same. "
                "Choose another directory, or delete this one."
            )
    replace_file("train", path, json.dumps(settings, indent=1).encode())


def _save(directory, params, state, step):
    content = serialization.to_bytes({"params": params, "state": state, "step": step})
    replace_file("train", directory / "state.msgpack", content)


def _restore(directory, params, state):
    path = directory / "state.msgpack"
    if not path.exists():
        return params, state, 0
    target = {"params": params, "state": state, "step": 0}
    saved = _read(path, lambda content: serialization.from_bytes(target, content))
    saved = jax.tree.map(jnp.asarray, saved)
    return saved["params"], saved["state"], int(saved["step"])


def _read(path, parse):
    try:
        return parse(path.read_bytes())
    except Exception as error:  # damaged files raise whatever their parser stumbles on
        reason = str(error).splitlines()[0] if str(error) else type(error).__name__
        raise InputError(f"train(): {path} cannot be read ({reason}); delete the folder, or restore the file") from None


def _step_of(line):
    """The step of a line of metrics; infinity for one that a kill cut short."""
    try:
        return json.loads(line)["step"]
    except json.JSONDecodeError:
        return float("inf")


def _drop_later_metrics(path, step):
    """A run killed after its last checkpoint repeats some steps; their first lines go."""
    if path.exists():
        rows = [line for line in path.read_text().splitlines() if _step_of(line) <= step]
        replace_file("train", path, "".join(line + "\n" for line in rows).encode())
