"""Work shared among the devices of a mesh, in one process or in several.

Each device takes a part of the starts or of a grid, and the processes exchange nothing but results.
"""

import functools
from collections.abc import Callable

import jax
import jax.core
import jax.numpy as jnp
import numpy as np
from jax.custom_batching import sequential_vmap
from jax.experimental import multihost_utils
from jax.sharding import Mesh, NamedSharding, PartitionSpec

from tdf_jax._internal.errors import InputError

REPLICATED = PartitionSpec()
# An accelerator holds 134 MB of descriptors at a time, and as much again for every tangent. The number is an estimate:
# it fills an accelerator and fits into its memory.
ACCELERATOR_POINTS = 16384

# Programs that run once a call: they compile in a half to a fifth of the time.
FAST_COMPILATION = {"xla_backend_optimization_level": 0, "xla_cpu_use_fusion_emitters": False}


def one_at_a_time() -> bool:
    """Whether equal pieces of work run faster one after the other than together.

    They do on a CPU, whose cache then holds one piece. An accelerator needs all of them together.
    """
    return jax.default_backend() == "cpu"


def tracing() -> bool:
    """Whether a function that `jax.jit` traces is running."""
    return isinstance(jnp.zeros(()), jax.core.Tracer)


def quickly_compiled(function: Callable, static_argnames: str | tuple[str, ...] = ()) -> Callable:
    """Decorator as `jax.jit`, of a program that runs once a call, see `FAST_COMPILATION`."""
    alone = jax.jit(function, static_argnames=static_argnames, compiler_options=FAST_COMPILATION)
    # A part of another program has no options of its own.
    part = jax.jit(function, static_argnames=static_argnames)

    @functools.wraps(function)
    def compiled(*arguments, **keywords):
        return (part if tracing() else alone)(*arguments, **keywords)

    return compiled


def mapped(function: Callable) -> Callable:
    """The function, which `jax.vmap` runs for one element after the other where that is faster, see `one_at_a_time`.

    It takes arrays by position, and has no reverse-mode derivative.
    """
    if not one_at_a_time():
        return function

    def one_by_one(*arguments):
        # Of leaves, because `sequential_vmap` puts its own values into the places of a pytree, whose class checks them.
        leaves, tree = jax.tree.flatten(arguments)
        return sequential_vmap(lambda *leaves: function(*jax.tree.unflatten(tree, leaves)))(*leaves)

    return one_by_one


def points_at_a_time(cpu_points: int) -> int:
    """How many query points to evaluate at a time.

    Args:
        cpu_points: number that fits the cache of a CPU.

    Returns:
        That number on a CPU; `ACCELERATOR_POINTS` on an accelerator.
    """
    return cpu_points if one_at_a_time() else ACCELERATOR_POINTS


def platform_problem() -> str | None:
    """Why JAX has no device to run on and what to do about it, as the end of an error message; None if it has one."""
    try:
        jax.devices()
    # JAX raises the second if the only platform that it may use is `cuda`, and its plugin is not installed.
    except (RuntimeError, AssertionError) as error:
        reason = str(error).splitlines()[0] if str(error) else "none is installed"
        wanted = jax.config.jax_platforms  # pyright: ignore[reportAttributeAccessIssue]: added at run time
        return (
            f"JAX has no device of the platform {wanted!r}, which JAX_PLATFORMS or jax_platforms asks for ({reason}); "
            "expected an available one. Unset JAX_PLATFORMS or set it to cpu, or install the JAX of your accelerator"
        )
    return None


def check_device_mesh(function: str, device_mesh) -> None:
    """Raise InputError unless the argument `device_mesh` is a mesh or None."""
    if device_mesh is not None and not isinstance(device_mesh, Mesh):
        raise InputError(
            f"{function}: device_mesh is {device_mesh!r}; expected a jax.sharding.Mesh, such as "
            "jax.make_mesh((2,), ('devices',))"
        )


def default_device_mesh() -> Mesh:
    """Mesh of JAX's default device of this process."""
    return Mesh(np.array(list(jnp.zeros(()).devices())), ("default",))


def sharded(device_mesh: Mesh) -> PartitionSpec:
    """Specification that splits the first axis into as many parts as the mesh has devices, whatever its shape."""
    return PartitionSpec(device_mesh.axis_names)


def placed(tree, device_mesh: Mesh, spec: PartitionSpec = REPLICATED):
    """Arrays placed on the devices of a mesh.

    Args:
        tree: arrays that are the same in all processes; with `sharded`, their lengths are multiples of the number of
            devices.
        device_mesh: devices, some of which other processes may hold.
        spec: `REPLICATED` or `sharded(device_mesh)`.

    Returns:
        The tree, its leaves as global arrays.
    """

    def place(leaf):
        # `device_put` refuses arrays on devices of this process for a mesh of several processes.
        leaf = np.asarray(leaf)
        return jax.make_array_from_callback(leaf.shape, NamedSharding(device_mesh, spec), lambda index: leaf[index])

    return jax.tree.map(place, tree)


def gathered(array: jax.Array) -> np.ndarray:
    """The whole array, in every process that takes part."""
    if array.is_fully_addressable:
        return np.asarray(array)
    return np.asarray(multihost_utils.process_allgather(array, tiled=True))


def padded(array: np.ndarray | jax.Array, device_mesh: Mesh) -> np.ndarray:
    """The array, repeated from its beginning up to a multiple of the number of devices."""
    array = np.asarray(array)
    return np.resize(array, (-(-len(array) // device_mesh.size) * device_mesh.size, *array.shape[1:]))
