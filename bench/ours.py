"""The benchmark's tasks in tdf_jax, by its public functions: as `bench.peer`, task for task."""

import functools
import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import optax
from flax.traverse_util import unflatten_dict

import tdf_jax as tdf
from bench import scene
from bench.workers import ROOT
from tdf_jax.geometry import se3
from tdf_jax.networks.occupancy import condition, decode, encode_latent


def prepare(task: str, tuned: bool, settings: dict, arrays: dict, state: dict[str, np.ndarray]) -> Callable[[], dict]:
    """One of this module's tasks, ready to be called; its first call compiles."""
    tensors = {name.replace(".weight", ".kernel"): jnp.asarray(tensor.T) for name, tensor in state.items()}
    latent, width = (len(state[name]) for name in ("encoder.fc_c.map_to_feat.weight", "decoder.fc_in.bias"))
    config = tdf.NetworkConfig(latent=latent, decoder_width=width)
    model = tdf.Model(unflatten_dict(tensors, sep="."), config, tdf.ModelInfo("bench", "its parent process"))
    return TASKS[task](model, settings, arrays)


def encode(model, settings, arrays):
    """The latent of one cloud, all points as they are."""
    program = jax.jit(encode_latent, static_argnums=1)
    points = jnp.asarray(arrays["cloud"])
    return lambda: {"latent": jax.block_until_ready(program(model.params, model.config, points))}


def gradient(model, settings, arrays):
    """Energies, and gradients with respect to rotations and centroids of the query points."""
    field, reference, energy = _problem(model, arrays)
    centre = jnp.mean(reference.query, axis=0)
    R0 = se3.rotation(jnp.asarray(arrays["starts"]))
    centroids = se3.transform(jnp.asarray(arrays["starts"]), centre[None])[..., 0, :]

    def value(rotation, centroid, R):
        R = se3.exp(rotation) @ R
        return tdf.trajectory_energy(tdf.Trajectory(se3.pose(R, centroid - R @ centre)), field, reference, energy)

    program = jax.jit(jax.vmap(jax.value_and_grad(value, argnums=(0, 1))))

    def call():
        energies, (rotation, centroid) = jax.block_until_ready(program(jnp.zeros_like(centroids), centroids, R0))
        return {"energies": energies, "rotation": rotation, "centroid": centroid}

    return call


def descent(model, settings, arrays):
    """`tdf.optimize` from the given starts: the whole call, or per step.

    A call evaluates its starts and its result besides its steps, so a step is the difference of two calls, of one step
    and of some more.
    """
    field, reference, energy = _problem(model, arrays)
    per_step = settings["per"] == "step"
    names = ("rotation_rate", "translation_rate", "final_rate")
    config = functools.partial(
        tdf.OptimizeConfig, num_starts=len(arrays["starts"]), **{name: settings[name] for name in names}
    )

    def timed(iterations):
        began = time.perf_counter()
        result = tdf.optimize(
            field,
            reference,
            jax.random.key(0),
            goal=jnp.asarray(arrays["goal"]),
            fix_last=settings["fix_last"],
            energy=energy,
            config=config(iterations=iterations),
            starts=jnp.asarray(arrays["starts"]),
        )
        jax.block_until_ready(result)
        return time.perf_counter() - began, result

    def call():
        if per_step:
            (first, _), (seconds, result) = timed(1), timed(1 + settings["steps"])
            # steps of a millisecond drown in noise: then all of the call counts
            more = seconds - first if seconds > first else seconds
            return {"losses": result.candidate_history[:, : settings["steps"]], "seconds": more / settings["steps"]}
        seconds, result = timed(settings["iterations"])
        return {"losses": result.candidate_history, "energies": result.energies, "seconds": seconds}

    return call


def solving(model, settings, arrays):
    """`tdf_jax.solvers.multistart.solve` with its default settings and starts of its own; the whole call."""
    from tdf_jax.solvers.multistart import SolveConfig, solve

    field, reference, energy = _problem(model, arrays)
    goal = jnp.asarray(arrays["goal"])

    def call():
        began = time.perf_counter()
        result = solve(
            field,
            reference,
            jax.random.key(0),
            goal=goal,
            fix_last=settings["fix_last"],
            energy=energy,
            config=SolveConfig(),
        )
        jax.block_until_ready(result)
        return {"energies": result.energies, "seconds": time.perf_counter() - began}

    return call


def picking(model, settings, arrays):
    """`tdf.track` from a pick before a motion, or `tdf.carry` after it; the whole call, without the encoding."""
    field, reference, _ = _problem(model, arrays)
    first = tdf.carry(field, reference, jax.random.key(0))
    moved = tdf.encode(model, jnp.asarray(arrays["moved"]))

    def call():
        began = time.perf_counter()
        if settings["track"]:
            result = tdf.track(moved, reference, first)
        else:
            result = tdf.carry(moved, reference, jax.random.key(1))
        jax.block_until_ready(result)
        seconds = time.perf_counter() - began
        return {"pick": result.pick, "energy": result.loss, "seconds": seconds}

    return call


def imitating(model, settings, arrays):
    """`tdf.imitate_batch` on all clouds, with the shipped weights of mugs, whose clouds are sampled and cleaned."""
    shipped = tdf.load_model("mug")
    path, query = tdf.Trajectory(jnp.asarray(arrays["path"])), jnp.asarray(arrays["query"])
    demonstration = tdf.Demonstration(jnp.asarray(arrays["shown"]), path, query)
    chunk = settings["chunk"]

    def call():
        results = tdf.imitate_batch(
            shipped, demonstration, list(arrays["clouds"]), key=jax.random.key(0), chunk_targets=chunk
        )
        jax.block_until_ready(results)
        return {"energies": np.array([float(result.loss) for result in results])}

    return call


def command(model, settings, arrays):
    """`tdf imitate` with default options as a process, from its start to its end, with or without kept programs."""
    folder = tempfile.TemporaryDirectory(prefix="bench_")
    environment = os.environ | {"XDG_CACHE_HOME": folder.name}
    environment.pop("JAX_COMPILATION_CACHE_DIR", None)
    start = "import sys; from tdf_jax.cli.main import main; sys.exit(main())"
    flags = [] if settings["kept"] else ["--no-cache"]

    def call():
        out = Path(folder.name) / "imitation"  # the folder lives as long as this function
        ended = subprocess.run(
            [sys.executable, "-c", start, "imitate", "--out", str(out), *flags],
            cwd=ROOT,
            env=environment,
            capture_output=True,
            text=True,
        )
        if ended.returncode:
            raise RuntimeError(f"tdf imitate ended with {ended.returncode}: {ended.stderr[-500:]}")
        record = json.loads((out / "result.json").read_text())
        return {"energy": record["loss"]["end"]}

    return call


def landscape(model, settings, arrays):
    """`tdf.energy_landscape`, one energy for each rotation."""
    field, reference, _ = _problem(model, arrays)
    grid = scene.plane(settings["count"], settings["pitch"], arrays["new"])
    rotations = arrays["rotations"]
    return lambda: {"values": tdf.energy_landscape(field, reference, grid, rotations, over_rotations="each").values}


def train(model, settings, arrays):
    """Adam steps on the weights, always from the same ones; binary cross-entropy of occupancy alone.

    Clouds one after the other, adding up gradients, as `tdf train` does it.
    """
    adam = optax.adam(settings["rate"])

    def loss(params, cloud, queries, inside):
        _, logits = decode(condition(params, model.config, encode_latent(params, model.config, cloud)), queries)
        return jnp.mean(optax.sigmoid_binary_cross_entropy(logits, inside))

    @functools.partial(jax.jit, donate_argnums=(0, 1))
    def step(params, state, clouds, queries, inside):
        def add(total, sample):
            value, gradient = jax.value_and_grad(loss)(params, *sample)
            return jax.tree.map(jnp.add, total, gradient), value

        total, values = jax.lax.scan(add, jax.tree.map(jnp.zeros_like, params), (clouds, queries, inside))
        updates, state = adam.update(jax.tree.map(lambda leaf: leaf / len(clouds), total), state, params)
        return optax.apply_updates(params, updates), state, jnp.mean(values)

    samples = tuple(jnp.asarray(arrays[name]) for name in ("clouds", "queries", "inside"))

    def call():
        params = jax.tree.map(jnp.copy, model.params)
        state = adam.init(params)
        jax.block_until_ready((params, state))
        losses, began = [], time.perf_counter()
        for _ in range(settings["steps"]):
            params, state, value = step(params, state, *samples)
            losses.append(float(value))
        jax.block_until_ready(params)
        return {"losses": losses, "seconds": (time.perf_counter() - began) / settings["steps"]}

    return call


def matmul(model, settings, arrays):
    """A square float32 product."""
    a, b = (jax.random.normal(key, (settings["size"],) * 2) for key in jax.random.split(jax.random.key(0)))
    program = jax.jit(jnp.matmul)
    return lambda: {"corner": jax.block_until_ready(program(a, b))[0, 0]}


TASKS = {
    task.__name__: task
    for task in (encode, gradient, descent, solving, picking, imitating, command, landscape, train, matmul)
}


def _problem(model, arrays):
    """The field, the reference and the energy's weights."""
    demonstration = tdf.Demonstration(
        jnp.asarray(arrays["shown"]), tdf.Trajectory(jnp.asarray(arrays["path"])), jnp.asarray(arrays["query"])
    )
    energy = tdf.EnergyWeights(correlation=float(arrays["correlation"]), rotation_scale=float(arrays["rotation_scale"]))
    return tdf.encode(model, jnp.asarray(arrays["new"])), tdf.describe(model, demonstration), energy
