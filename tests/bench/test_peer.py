"""The peer of the benchmark is the original network and agrees with tdf_jax; a run with both measures and agrees.

These tests need the extra `bench`. No times are asserted.
"""

import json

import numpy as np
import pytest
from conftest import TOLERANCE, enabled, relative_error

torch = pytest.importorskip("torch", reason="the peer of the benchmark needs the extra 'bench'")

# These import torch themselves.
from bench import __main__ as command_line, gate, machine, ndf_torch, ours, peer, report, scene  # noqa: E402
from bench.rows import NDF_RATES, QUICK, rows  # noqa: E402

# ---- the peer ----


@pytest.fixture(scope="module")
def state(golden):
    return scene.weights(golden.model)


@pytest.fixture(scope="module")
def small_scene():
    return scene.imitation(2, 3, 20)


def test_the_peer_is_the_original(golden, state, precision):
    inputs = {name: golden.arrays[name] for name in ("point_cloud", "coords")}
    found = peer.prepare("golden", False, {"double": precision == "float64"}, inputs, state)()
    for name in ("latent", "features", "occupancy"):
        assert relative_error(found[name], golden.arrays[name]) < TOLERANCE[precision], name


def test_the_peers_trajectory_losses_and_gradients_are_the_originals(golden, state):
    arrays = {name: torch.tensor(array) for name, array in golden.arrays.items()}
    network = ndf_torch.load(state, torch.float64).requires_grad_(False)
    latents = network.encoder(arrays["point_cloud"])
    R_ref = ndf_torch.exponential(arrays["traj_rot_ref"])
    x = arrays["traj_query"] @ R_ref.mT + arrays["traj_t_ref"][:, None]
    descriptors = network.descriptors(x.reshape(1, -1, 3), latents[:1]).reshape(*x.shape[:2], -1)
    centre = arrays["traj_query"].mean(0)
    zero = torch.zeros(3, dtype=torch.float64)
    problem = ndf_torch.Problem(
        latents[1:], zero, arrays["traj_query"], descriptors, R_ref, arrays["traj_t_ref"], 0.0, 1.0
    )
    rot, t = (arrays[f"traj_{name}"].clone().requires_grad_() for name in ("rot", "t"))
    R = ndf_torch.exponential(rot)
    loss = ndf_torch.descriptor_losses(network, problem, R[None], (R @ centre + t)[None])[0]
    loss.backward()
    # The original's rotations carry an epsilon of 1e-6.
    assert relative_error(loss.item(), golden.arrays["traj_loss"]) < 1e-7
    assert relative_error(t.grad, golden.arrays["traj_grad_t"]) < 1e-5
    assert relative_error(rot.grad, golden.arrays["traj_grad_rot"]) < 1e-5


@pytest.mark.parametrize("tuned", [False, True])
def test_the_peers_energies_and_gradients_are_ours(golden, state, small_scene, tuned):
    with enabled("float32"):
        expected = ours.prepare("gradient", False, {}, small_scene, state)()
    found = peer.prepare("gradient", tuned, {}, small_scene, state)()
    assert relative_error(found["energies"], expected["energies"]) < 1e-5
    for name in ("rotation", "centroid"):  # of the free poses: the last one lies where eq. 3's norm has its kink
        assert relative_error(found[name][:, :-1], expected[name][:, :-1]) < 1e-3


def test_descents_agree_and_the_tuned_peer_evaluates_the_fixed_pose_once(golden, state, small_scene):
    settings = NDF_RATES | {"steps": 3, "iterations": 3, "final_rate": 0.1, "fix_last": True, "per": "call"}
    found = {tuned: peer.prepare("descent", tuned, settings, small_scene, state)() for tuned in (False, True)}
    expected = ours.prepare("descent", False, settings, small_scene, state)()
    for result in found.values():
        assert result["losses"].shape == (2, 3)
        for name in ("losses", "energies"):
            assert relative_error(result[name], expected[name]) < 1e-3
    # it moves
    assert np.asarray(expected["losses"])[0, 0] != pytest.approx(np.asarray(expected["losses"])[0, 2], rel=1e-3)


# ---- a run ----


@pytest.fixture(scope="module")
def quick(tmp_path_factory):
    """Everything once, at small sizes."""
    folder = tmp_path_factory.mktemp("bench")
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("JAX_DISABLE_MOST_OPTIMIZATIONS", "1")
        # threads that wait for each other would lose most of the time to the other tests
        patch.setenv("OMP_NUM_THREADS", "1")
        assert command_line.main(["--quick", "--repetitions", "1", "--scaling", "--out", str(folder)]) == 0
    return folder


def test_a_run_measures_every_row_and_agrees(quick):
    record = json.loads((quick / "bench.json").read_text())
    assert list(record["rows"]) == [row.name for row in rows(QUICK)]
    assert len(record["parity"]) == 12 and gate.failed_checks(record) == []
    assert record["machine"]["torch"] == torch.__version__ and record["machine"]["cores"] >= 1
    for name, row in record["rows"].items():
        assert row["errors"] == {} and row["checks"] or name == "target_rates"
        assert row["ratios"].keys() == row["ratios_of_least"].keys() and row["ratios"]
        for competitor, found in row["competitors"].items():
            seconds = found["seconds"]
            assert 0 < seconds["least"] <= seconds["median"] <= seconds["most"] and np.isfinite(seconds["most"])
            assert (found["gflops"] is None) == (competitor == "tdf_jax_solve" or name in ("track", "batch", "command"))
            if machine.resident():
                assert found["peak_megabytes"] >= 0.9 * found["base_megabytes"] > 0
    facts = record["rows"]["target"]["facts"]
    assert facts["energies"]["tdf_jax"] <= facts["target"]
    evaluations = record["rows"]["landscape"]["facts"]["evaluations"]
    assert 0 < evaluations["tdf_jax"]
    assert set(record["scaling"]) == {"inits", "points"}


def test_a_run_is_written_and_drawn(quick):
    words = (quick / "bench.md").read_text()
    record = json.loads((quick / "bench.json").read_text())
    assert words == report.markdown(record)
    assert all(row["title"] in words for row in record["rows"].values())
    assert "the times mean nothing" in words
    assert (quick / "scaling.png").read_bytes().startswith(b"\x89PNG")
    tables = [line for line in words.splitlines() if line.startswith("|")]
    assert all(line.endswith("|") for line in tables)


def test_a_run_passes_its_own_gate(quick, capsys):
    record = gate.read(quick / "bench.json")
    assert command_line._verdict(record, record) == 0
    assert "gate: passed" in capsys.readouterr().out
    better = json.loads(json.dumps(record))
    pair = next(iter(better["rows"]["train"]["ratios"]))
    better["rows"]["train"]["ratios"][pair] *= 2
    assert command_line._verdict(record, better) == 1
    assert f"failed: train: {pair}" in capsys.readouterr().err
