"""The benchmark's tasks in PyTorch.

Each task takes a network, whether an expert tuned it, its settings and its arrays, and gives a function to call again
and again that returns its results, and "seconds" where not the whole call counts. Tuned: no gradients for weights that
nobody trains, one thread a core, the fixed last pose evaluated once; what glibc keeps is set where the process is
started (`bench.workers`).
"""

import os
import time
from collections.abc import Callable

import numpy as np
import torch
from torch.nn import functional as F

from bench import ndf_torch
from bench.machine import cores
from bench.ndf_torch import OccupancyNetwork, Problem, descriptor_losses, exponential, pose_losses

# grid points evaluated at a time: as many as NDF's starts; 500 descriptors are 4 MB and stay in cache
TOGETHER = {False: 10, True: 2}


def prepare(task: str, tuned: bool, settings: dict, arrays: dict, state: dict[str, np.ndarray]) -> Callable[[], dict]:
    """One of this module's tasks, ready to be called."""
    network = ndf_torch.load(state, torch.float64 if settings.get("double") else torch.float32)
    network.requires_grad_(not tuned or task == "train")
    if tuned:
        torch.set_num_threads(int(os.environ.get("OMP_NUM_THREADS", cores())))
    dtype = next(network.parameters()).dtype
    tensors = {name: torch.tensor(array, dtype=dtype) for name, array in arrays.items()}
    return TASKS[task](network, tuned, settings, tensors)


def golden(network, tuned, settings, arrays):
    """Latents, descriptors and occupancies of a batch of objects."""

    @torch.no_grad()
    def call():
        latent = network.encoder(arrays["point_cloud"])
        x = arrays["coords"]
        return {"latent": latent, "features": network.descriptors(x, latent), "occupancy": network.occupancy(x, latent)}

    return call


def encode(network, tuned, settings, arrays):
    """The latent of one cloud."""
    return lambda: {"latent": network.encoder(arrays["cloud"][None])[0].detach()}


def gradient(network, tuned, settings, arrays):
    """Energies, and gradients with respect to rotations and centroids of the query points."""
    problem, R0, centroids = _problem(network, arrays)

    def call():
        rotation, centroid = torch.zeros_like(centroids, requires_grad=True), centroids.clone().requires_grad_()
        energies = _energies(network, problem, R0, rotation, centroid)
        energies.sum().backward()
        return {"energies": energies.detach(), "rotation": rotation.grad, "centroid": centroid.grad}

    return call


def descent(network, tuned, settings, arrays):
    """Adam from the given starts. The latent is encoded before, as NDF does, so steps evaluate the decoder alone.

    Settings: steps to take, of `iterations` that the falling rates are laid out for; rates; fix_last; per "step" or
    "call".
    """
    problem, R0, centroids = _problem(network, arrays)
    iterations, steps, fix_last = settings["iterations"], settings["steps"], settings["fix_last"]
    free = centroids.shape[1] - fix_last
    shared = tuned and fix_last

    def energies(rotation, centroid, fixed):
        rotation = torch.cat([rotation, torch.zeros_like(centroids[:, free:])], dim=1)
        centroid = torch.cat([centroid, centroids[:, free:]], dim=1)
        if not shared:
            return _energies(network, problem, R0, rotation, centroid)
        R = exponential(rotation) @ R0
        moving = descriptor_losses(network, problem, R[:, :free], centroid[:, :free])
        return (free * moving + fixed) / centroids.shape[1] + pose_losses(problem, R, centroid)

    def call():
        began = time.perf_counter()
        rotation = torch.zeros_like(centroids[:, :free], requires_grad=True)
        centroid = centroids[:, :free].clone().requires_grad_()
        rates = settings["rotation_rate"], settings["translation_rate"]
        adam = torch.optim.Adam([{"params": [rotation]}, {"params": [centroid]}])
        fixed, losses = None, []
        if shared:
            with torch.no_grad():
                fixed = descriptor_losses(network, problem, R0[:, free:], centroids[:, free:], first=free)
        for step in range(steps):
            decay = settings["final_rate"] + (1 - settings["final_rate"]) * 0.5 * (
                1 + np.cos(np.pi * step / iterations)
            )
            for group, rate in zip(adam.param_groups, rates):
                group["lr"] = rate * decay
            loss = energies(rotation, centroid, fixed)
            adam.zero_grad()
            loss.sum().backward()  # the sum, not the mean: Adam does not mind, and both sides then see the same numbers
            adam.step()
            losses.append(loss.detach())
        seconds = time.perf_counter() - began
        result = {
            "losses": torch.stack(losses, dim=1),
            "seconds": seconds / steps if settings["per"] == "step" else seconds,
        }
        if steps == iterations and settings["per"] == "call":
            with torch.no_grad():
                result["energies"] = energies(rotation, centroid, fixed)
        return result

    return call


def landscape(network, tuned, settings, arrays):
    """Energies of query points in several orientations, (waypoints, rotations, *grid); waypoints share descriptors."""
    problem, _, _ = _problem(network, arrays)
    latent, grid = problem.latents[:1], arrays["grid"].reshape(-1, 3)

    @torch.no_grad()
    def call():
        values = []
        for R in arrays["rotations"]:
            here = problem.query @ R.T - problem.origin
            for some in grid.split(TOGETHER[tuned]):
                x = some[:, None] + here
                found = network.descriptors(x.reshape(1, -1, 3), latent).reshape(len(some), len(here), -1)
                values.append(torch.stack([(found - there).abs().mean((1, 2)) for there in problem.descriptors]))
        sizes = len(arrays["rotations"]), *arrays["grid"].shape[:-1]
        return {"values": torch.cat(values, dim=1).reshape(-1, *sizes)}

    return call


def train(network, tuned, settings, arrays):
    """Adam steps on the weights, always from the same ones; binary cross-entropy of occupancy alone."""
    initial = {name: tensor.clone() for name, tensor in network.state_dict().items()}

    def call():
        network.load_state_dict(initial)
        adam = torch.optim.Adam(network.parameters(), lr=settings["rate"])
        losses, began = [], time.perf_counter()
        for _ in range(settings["steps"]):
            _, logits = network.decoder(arrays["queries"], network.encoder(arrays["clouds"]))
            loss = F.binary_cross_entropy_with_logits(logits, arrays["inside"])
            adam.zero_grad()
            loss.backward()
            adam.step()
            losses.append(loss.item())
        return {"losses": losses, "seconds": (time.perf_counter() - began) / settings["steps"]}

    return call


def matmul(network, tuned, settings, arrays):
    """A square float32 product."""
    a, b = (torch.randn(settings["size"], settings["size"]) for _ in range(2))
    return lambda: {"corner": (a @ b)[0, 0]}


TASKS = {task.__name__: task for task in (golden, encode, gradient, descent, landscape, train, matmul)}


def _problem(network: OccupancyNetwork, arrays):
    """The problem, and every start's orientations and centroids of the query points."""
    shown, new, query = arrays["shown"], arrays["new"], arrays["query"]
    R, t = _matrices(arrays["path"])
    with torch.no_grad():
        latents = network.encoder(torch.stack([shown - shown.mean(0), new - new.mean(0)]))
        x = query @ R.transpose(-1, -2) + t[:, None] - shown.mean(0)
        descriptors = torch.cat([network.descriptors(one[None], latents[:1]) for one in x])
        R0, t0 = _matrices(arrays["starts"])
    repeated = latents[1:].repeat(len(R0), 1, 1)
    k, rotation_scale = (float(arrays[name]) for name in ("correlation", "rotation_scale"))
    problem = Problem(repeated, new.mean(0), query, descriptors, R, t - shown.mean(0), k, rotation_scale)
    return problem, R0, R0 @ query.mean(0) + t0


def _energies(network, problem, R0, rotation, centroid):
    R = exponential(rotation) @ R0
    return descriptor_losses(network, problem, R, centroid) + pose_losses(problem, R, centroid)


def _matrices(wxyz_xyz):
    """Rotations (..., 3, 3) and translations (..., 3) of poses."""
    w, x, y, z = F.normalize(wxyz_xyz[..., :4], dim=-1).unbind(-1)
    rows = [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)]
    rows += [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)]
    rows += [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)]
    return torch.stack(rows, dim=-1).unflatten(-1, (3, 3)), wxyz_xyz[..., 4:]
