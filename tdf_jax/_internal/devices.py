"""Work shared among the devices of a mesh, in one process or several: each takes a part of the starts or of a grid, and only results are exchanged."""

import jax
import jax.numpy as jnp
import numpy as np
from jax.experimental import multihost_utils
from jax.sharding import Mesh, NamedSharding, PartitionSpec

from tdf_jax._internal.errors import InputError

WHOLE = PartitionSpec()
# Descriptors held at a time on an accelerator: 134 MB, and as much again for every tangent. An estimate: enough to fill
# it, few enough for its memory.
ACCELERATOR_POINTS = 16384

ONCE = {"xla_backend_optimization_level": 0}  # for programs that run once a call: half the time to compile


def one_at_a_time() -> bool:
    """Whether equal work is faster one piece after the other: on a CPU, whose cache then holds it; an accelerator wants all of it together."""
    return jax.default_backend() == "cpu"


def points_at_a_time(cpu_points: int) -> int:
    """How many query points to evaluate at a time: a CPU wants them in its cache, an accelerator wants many."""
    return cpu_points if one_at_a_time() else ACCELERATOR_POINTS


def check_mesh(function: str, mesh) -> None:
    """Raise InputError unless it is a mesh, or None."""
    if mesh is not None and not isinstance(mesh, Mesh):
        raise InputError(
            f"{function}: mesh is {mesh!r}; expected a jax.sharding.Mesh, such as jax.make_mesh((2,), ('devices',))"
        )


def alone() -> Mesh:
    """Jax's default device of this process as a mesh."""
    return Mesh(np.array(list(jnp.zeros(()).devices())), ("alone",))


def split(mesh: Mesh) -> PartitionSpec:
    """The first axis in as many parts as the mesh has devices, whatever its shape."""
    return PartitionSpec(mesh.axis_names)


def placed(tree, mesh: Mesh, spec: PartitionSpec = WHOLE):
    """Arrays on the devices of a mesh, whole on each by default.

    Args:
        tree: the same in all processes; to be split, lengths are multiples of the number of devices.
        mesh: of devices, of which other processes may hold some.
        spec: `WHOLE` or `split(mesh)`.
    """

    def place(leaf):
        # Not `device_put`, which refuses arrays that are on devices of this process for a mesh of several processes.
        leaf = np.asarray(leaf)
        return jax.make_array_from_callback(leaf.shape, NamedSharding(mesh, spec), lambda index: leaf[index])

    return jax.tree.map(place, tree)


def gathered(array: jax.Array) -> np.ndarray:
    """All of an array, in every process that takes part."""
    if array.is_fully_addressable:
        return np.asarray(array)
    return multihost_utils.process_allgather(array, tiled=True)


def padded(array: np.ndarray, mesh: Mesh) -> np.ndarray:
    """An array repeated from its beginning up to a multiple of the number of devices."""
    array = np.asarray(array)
    return np.resize(array, (-(-len(array) // mesh.size) * mesh.size, *array.shape[1:]))
