"""Products are float32 products where fields and both optimisers compute them; training leaves it to the device."""

import functools
import sys

import jax
import jax.extend.core
import jax.numpy as jnp
import numpy as np
import pytest
from conftest import SMALL, random_cloud, random_poses

import tdf_jax as tdf
from tdf_jax._internal.precision import full_precision
from tdf_jax.geometry import se3
from tdf_jax.solvers import gauss_newton
from tdf_jax.training.objective import mean_gradient

EXACT, FAST = jax.lax.Precision.HIGHEST, jax.lax.Precision.DEFAULT


def precisions(function, *arguments):
    """Of all products in a program, those of its loops and derivatives included."""
    found, stack = set(), [jax.make_jaxpr(function)(*arguments).jaxpr]
    while stack:
        for equation in stack.pop().eqns:
            if equation.primitive.name == "dot_general":
                precision = equation.params["precision"]
                found |= set(precision) if isinstance(precision, tuple) else {precision}
            stack += [
                leaf
                for leaf in jax.tree.leaves(equation.params, is_leaf=is_jaxpr)
                if isinstance(leaf, jax.extend.core.Jaxpr)
            ]
            stack += [
                leaf.jaxpr
                for leaf in jax.tree.leaves(equation.params, is_leaf=is_jaxpr)
                if isinstance(leaf, jax.extend.core.ClosedJaxpr)
            ]
    return found


def is_jaxpr(leaf):
    return isinstance(leaf, jax.extend.core.Jaxpr | jax.extend.core.ClosedJaxpr)


@pytest.fixture(scope="module")
def problem(small_model):
    """A field, a reference on it, and a key."""
    points = random_cloud(0).astype(np.float32)
    path = tdf.Trajectory(random_poses(0, 2).astype(np.float32))
    demonstration = tdf.Demonstration(points, path, tdf.box_query(jax.random.key(0), count=8, size=0.05))
    return tdf.encode(small_model, points), tdf.describe(small_model, demonstration), jax.random.key(1)


def test_a_program_without_it_is_as_the_device_likes():
    """The check below sees what it looks for."""

    def product(x):
        return jax.lax.fori_loop(0, 2, lambda _, y: y @ x, x)

    assert precisions(product, jnp.eye(3)) == {None}
    assert precisions(full_precision(product), jnp.eye(3)) == {EXACT}
    with jax.default_matmul_precision("default"):
        assert precisions(full_precision(product), jnp.eye(3)) == {FAST}


def test_fields_and_their_derivatives_are_exact(small_model, problem):
    points = jnp.asarray(random_cloud(0), jnp.float32)
    assert precisions(lambda points: tdf.encode(small_model, points), points) == {EXACT}
    field, reference, _ = problem

    def energy(wxyz_xyz):
        return tdf.trajectory_energy(tdf.Trajectory(wxyz_xyz), field, reference, tdf.EnergyWeights())

    assert precisions(jax.grad(energy), jnp.asarray(random_poses(1, 2), jnp.float32)) == {EXACT}
    with jax.default_matmul_precision("tensorfloat32"):
        assert precisions(field.descriptors, points) == {jax.lax.Precision.HIGH}


def test_rotations_are_multiplied_exactly_whatever_is_set():
    with jax.default_matmul_precision("tensorfloat32"):
        assert precisions(se3.multiply, jnp.eye(3), jnp.eye(3)) == {EXACT}


@pytest.mark.slow
@pytest.mark.parametrize(("optimise", "config", "module", "program"), [
    (tdf.solve, tdf.SolveConfig(num_trajectory_starts=2), gauss_newton, "descend"),
    (tdf.optimize, tdf.OptimizeConfig(num_starts=2, iterations=2), sys.modules["tdf_jax.solvers.adam"], "_run"),
])  # fmt: skip
def test_both_optimisers_are_exact(problem, monkeypatch, optimise, config, module, program):
    found, run = [], getattr(module, program)

    def noted(*arguments, **options):
        found.append(precisions(functools.partial(run, **options), *arguments))
        raise InterruptedError  # traced is enough

    monkeypatch.setattr(module, program, noted)
    with pytest.raises(InterruptedError):
        optimise(*problem, config=config)
    assert found == [{EXACT}]


@pytest.mark.slow
def test_training_is_as_fast_as_the_device_likes(small_model):
    clouds = np.stack([random_cloud(seed) for seed in range(2)])[None]
    shapes = (8, 3), (8,), (3,), (), (5, 3), (6, 5, 3)
    samples = [np.zeros((1, 2, *shape), np.float32) for shape in shapes]
    params = {"network": small_model.params, "frame": jnp.zeros((SMALL.latent, 3))}

    def gradient(params):
        return mean_gradient(params, SMALL, clouds.astype(np.float32), *samples)

    assert precisions(gradient, params) == {FAST}
    with jax.default_matmul_precision("highest"):
        assert precisions(gradient, params) == {EXACT}
