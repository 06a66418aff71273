"""Many devices and several processes give what one device gives."""

import os
import socket
import subprocess
import sys

import pytest
from conftest import quick_environment

# Argument 1 is the folder of conftest.py; with two more, the process is one of two and holds four of eight devices.
SCRIPT = """
import sys; sys.path.insert(0, sys.argv[1])
import jax, jax.numpy as jnp, numpy as np
several = len(sys.argv) > 2
if several:
    jax.distributed.initialize(f'127.0.0.1:{sys.argv[2]}', num_processes=2, process_id=int(sys.argv[3]))
import tdf_jax as tdf
from conftest import SMALL, random_cloud
from tdf_jax.landscape import shared_lattice
from tdf_jax.networks.occupancy import initialise

assert (len(jax.devices()), len(jax.local_devices())) == (8, 4 if several else 8)
model = tdf.Model(initialise(jax.random.key(0), SMALL), SMALL, tdf.ModelInfo('small', 'test'))
cloud = jnp.asarray(random_cloud(0), jnp.float32)
path = tdf.wave(4, start=(0, 0, 0), end=(0, 0.2, 0))
reference = tdf.describe(model, tdf.Demonstration(cloud, path, tdf.box_query(jax.random.key(1), 20, 0.06)))
field = tdf.encode(model, cloud + 0.01)
calls = []
stages = {f'{stage}_steps': count for stage, count in zip(
    ('coarse', 'prune', 'search', 'propagate', 'refine', 'polish'), (3, 3, 3, 2, 2, 3)
)}
solver = tdf.SolveConfig(num_starts=13, num_trajectory_starts=3, num_coarse_queries=8, **stages)
for config, rows in ((tdf.OptimizeConfig(num_starts=11, iterations=5), 11), (solver, 2)):
    minimise = tdf.optimize if isinstance(config, tdf.OptimizeConfig) else tdf.solve
    one = minimise(field, reference, jax.random.key(2), config=config)
    mesh = jax.make_mesh((4, 2), ('hosts', 'starts')) if several else jax.make_mesh((8,), ('starts',))
    many = minimise(
        field, reference, jax.random.key(2), config=config, device_mesh=mesh,
        progress=lambda done, energies: calls.append(energies.shape)
    )
    assert many.trajectories.shape == (rows, 4, 7)
    for name in ('trajectories', 'energies', 'candidate_history', 'initial_trajectories', 'history'):
        message = f'{minimise.__name__} {name}'
        np.testing.assert_allclose(getattr(many, name), getattr(one, name), rtol=1e-5, atol=1e-5, err_msg=message)
assert calls == [(11,)] + [(2,)] * 6

shared_lattice.NODES, used, kept = 60, set(), shared_lattice._tile
def noted(*arguments):
    found = kept(*arguments)
    used.update(found.devices())
    return found
shown = tdf.describe(model, tdf.Demonstration(cloud, path, tdf.lattice_query((2, 2, 2), 0.02)))
grid = tdf.plane_grid(0.2, 21)
one = tdf.energy_landscape(field, shown, grid)
shared_lattice._tile = noted
tiles = []
many = tdf.energy_landscape(field, shown, grid, device_mesh=mesh, progress=lambda done, total: tiles.append(total))
np.testing.assert_allclose(many.values, one.values, rtol=1e-5)
assert used == set(jax.local_devices()), used
assert len(tiles) == tiles[0] and tiles[0] % 8, tiles  # the last round leaves some devices without a tile
print('equal')
"""


def processes(tmp_path, devices, arguments):
    script = tmp_path / "devices.py"
    script.write_text(SCRIPT)
    environment = os.environ | quick_environment() | {"JAX_PLATFORMS": "cpu"}
    environment["XLA_FLAGS"] += f" --xla_force_host_platform_device_count={devices}"
    command = [sys.executable, str(script), os.path.dirname(os.path.dirname(__file__))]
    running = [
        subprocess.Popen([*command, *more], env=environment, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
        for more in arguments
    ]
    return [(one.communicate(timeout=300), one.returncode) for one in running]


@pytest.mark.slow
def test_eight_devices(tmp_path):
    ((output, error), code) = processes(tmp_path, 8, [[]])[0]
    assert code == 0 and output == "equal\n", error


@pytest.mark.slow
def test_two_processes(tmp_path):
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = str(probe.getsockname()[1])
    for (output, error), code in processes(tmp_path, 4, [[port, "0"], [port, "1"]]):
        assert code == 0 and "equal\n" in output, error
