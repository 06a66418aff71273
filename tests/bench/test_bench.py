"""The machinery of the benchmark: it measures, reports and gates. No times are asserted."""

import jax
import numpy as np
import pytest
from flax.traverse_util import unflatten_dict

import tdf_jax as tdf
from bench import __main__ as command_line, flops, gate, rows as all_rows
from bench.measure import Plan, Row, check, measure, ratios
from bench.rows import agree, rows
from bench.workers import WorkerError, Workers
from tdf_jax.networks.occupancy import condition, parameter_shapes


def test_operations_are_those_of_the_folded_network():
    config = tdf.NetworkConfig()
    latent = jax.ShapeDtypeStruct((config.latent, 3), np.float32)
    shapes = {name: jax.ShapeDtypeStruct(shape, np.float32) for name, shape in parameter_shapes(config).items()}
    folded = jax.eval_shape(lambda params, z: condition(params, config, z), unflatten_dict(shapes, sep="."), latent)
    sizes = (
        folded.latent.size
        + folded.into[1].size
        + sum(kernel.size for block in folded.blocks for kernel in (block[0], block[2]))
    )
    assert flops.decoder(5) == 5 * 2 * sizes
    # The encoder's maps of all points: everything but the edges, the read-out, and the pooled halves of blocks 1 to 4.
    maps = {name: np.prod(shape) for name, shape in parameter_shapes(config).items() if name.startswith("encoder.")}
    left_out = [name for name in maps if "conv_pos" in name or "_c." in name]
    pooled = sum(
        maps[f"encoder.block_{b}.{name}.kernel"] / 2
        for b in range(1, 5)
        for name in ("actvn_0.map_to_dir", "shortcut.map_to_feat")
    )
    every_point = sum(maps.values()) - sum(maps[name] for name in left_out) - pooled
    edges = 2 * 4 * 20 * config.vector_hidden + 3 * 2 * 3 * config.vector_hidden
    assert flops.encoder(1) == pytest.approx(2 * (edges + 3 * every_point))


# ---- measuring, with made-up competitors ----


class Scripted:
    """Answers as children would, without any: times by competitor, one result for all but those named wrong."""

    def __init__(self, times, wrong=(), dead=()):
        self.times, self.wrong, self.dead, self.order = times, wrong, dead, []

    def ask(self, name, kind, payload=None):
        if kind == "run":
            if name in self.dead:
                raise WorkerError("the process ended with -9")
            self.order.append(name)
            value = 2.0 if name in self.wrong else 1.0
            seconds = self.times[name]
            return {"seconds": seconds, "wall": 3 * seconds, "worked": 0.0, "result": {"value": np.full(3, value)}}
        return {"resident": 1e6, "peak": 3e6}


def row(**settings):
    plans = {name: Plan("task", **plan) for name, plan in settings.items()}
    return Row("made_up", "made up", {"size": 1}, dict, plans, agree({"value": 1e-3}), 8e9)


def test_competitors_alternate_after_a_first_call():
    workers = Scripted({"torch": 4.0, "torch_tuned": 2.0, "tdf_jax": 0.5})
    found = measure(row(torch={}, torch_tuned={"once": True}, tdf_jax={}), workers, {}, 2)
    assert workers.order == ["torch", "torch_tuned", "tdf_jax", "torch", "tdf_jax", "torch", "tdf_jax"]
    assert found["ratios"] == found["ratios_of_least"] == {"torch / tdf_jax": 8.0, "torch_tuned / tdf_jax": 4.0}
    ours = found["competitors"]["tdf_jax"]
    assert ours["seconds"]["all"] == [0.5, 0.5] and ours["compile_seconds"] == 0.0
    assert ours["gflops"] == pytest.approx(16.0)
    assert ours["peak_megabytes"] == 3.0 and ours["base_megabytes"] == 1.0
    assert found["competitors"]["torch_tuned"]["compile_seconds"] is None


def test_a_part_of_the_work_counts_as_the_whole():
    found = measure(
        row(torch={"scale": 10.0, "note": "a tenth"}, tdf_jax={}), Scripted({"torch": 4.0, "tdf_jax": 0.5}), {}, 1
    )
    assert found["ratios"] == {"torch / tdf_jax": 80.0}
    assert found["competitors"]["torch"]["note"] == "a tenth"


def test_what_disagrees_is_not_timed():
    workers = Scripted({"torch": 4.0, "tdf_jax": 0.5}, wrong=("tdf_jax",))
    found = measure(row(torch={}, tdf_jax={}), workers, {}, 5)
    assert workers.order == ["torch", "tdf_jax"]
    assert found["ratios"] == {} and not found["checks"][0]["passed"]
    record = {"parity": [], "rows": {"made_up": found}}
    assert gate.failed_checks(record) == ["made_up: value, tdf_jax and torch is 1.0e+00; expected at most 1.0e-03"]


def test_a_competitor_that_dies_is_reported_and_the_others_are_measured():
    found = measure(
        row(torch={}, torch_tuned={}, tdf_jax={}),
        Scripted({"torch_tuned": 2.0, "tdf_jax": 0.5}, dead=("torch",)),
        {},
        1,
    )
    assert found["ratios"] == {"torch_tuned / tdf_jax": 4.0}
    assert gate.failed_checks({"parity": [], "rows": {"made_up": found}}) == [
        "made_up: torch failed: the process ended with -9"
    ]


def test_nothing_is_compared_where_all_competitors_failed():
    assert agree({"value": 1e-3})({}) == ([], {})


def test_not_a_number_fails_a_check():
    assert not check("it", float("nan"), 1.0)["passed"]


def test_a_child_answers_and_reports_its_errors():
    with Workers() as workers:
        assert workers.ask("tdf_jax", "settle")["resident"] > 0
        assert workers.ask("tdf_jax", "peak")["peak"] > 0
        with pytest.raises(WorkerError, match="KeyError: 'no such request'"):
            workers.ask("tdf_jax", "no such request")
        workers._started["tdf_jax"].process.kill()
        with pytest.raises(WorkerError, match="ended with -9, probably out of memory"):
            workers._started["tdf_jax"].ask("settle")
        assert workers.ask("tdf_jax", "settle")["resident"] > 0  # another one


# ---- the gate ----


def made_up(ratio, sizes=None, **about):
    step = {"sizes": sizes or {"inits": 10}, "ratios": {"torch / tdf_jax": ratio}, "checks": [], "errors": {}}
    return {"rows": {"step_10": step | about}, "parity": []}


@pytest.mark.parametrize(("found", "lost"), [(5.0, False), (3.1, False), (2.9, True), (50.0, False)])
def test_the_gate_is_wide(found, lost):
    failures, apart = gate.lost_ratios(made_up(found), made_up(5.0))
    assert bool(failures) == lost and not apart
    if lost:
        assert failures == ["step_10: torch / tdf_jax is 2.90, 0.58 of the baseline's 5.00; expected 0.6 of it"]


def test_the_gate_compares_like_with_like():
    failures, apart = gate.lost_ratios(made_up(0.1, sizes={"inits": 2}), made_up(5.0))
    assert not failures and apart == ["step_10: not in the baseline at these sizes"]
    failures, _ = gate.lost_ratios(made_up(0.1, ratios={}), made_up(5.0))
    assert failures == ["step_10: no ratio torch / tdf_jax; the baseline's is 5.00"]


def test_ratios_are_of_every_peer_and_each_of_ours():
    times = {"torch": 6.0, "torch_tuned": 3.0, "tdf_jax": 2.0, "tdf_jax_solve": 1.0}
    found = ratios({name: {"seconds": {"median": seconds}} for name, seconds in times.items()})
    assert found == {
        "torch / tdf_jax": 3.0, "torch_tuned / tdf_jax": 1.5,
        "torch / tdf_jax_solve": 6.0, "torch_tuned / tdf_jax_solve": 3.0
    }  # fmt: skip


# ---- the command ----


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["--only", "step_7"], "--only step_7; expected some of encode_60, step_2, target"),
        (["--repetitions", "0"], "--repetitions is 0"),
        (["--scaling"], "--scaling without --out"),
        (["--gate", "--baseline", "missing.json"], "cannot read the baseline missing.json"),
        (["--gate", "--baseline", __file__], "cannot read the baseline"),
        (["--out", __file__], "cannot write to"),
    ],
)
def test_mistakes_are_one_line_and_exit_code_2(capsys, monkeypatch, words, message):
    monkeypatch.setattr(command_line.importlib.util, "find_spec", lambda name: name)  # as if torch were installed
    assert command_line.main(["--quick", *words]) == 2
    assert message in capsys.readouterr().err


def test_without_torch_the_extra_is_named(capsys, monkeypatch):
    monkeypatch.setattr(command_line.importlib.util, "find_spec", lambda name: None)
    assert command_line.main([]) == 2
    assert "pip install 'tdf_jax[bench]'" in capsys.readouterr().err


def test_full_sizes_have_the_rows_and_their_operations():
    names = [row.name for row in rows(command_line.Sizes())]
    assert names == [
        "encode_1000",
        "encode_1500",
        "step_1",
        "step_10",
        "step_64",
        "target",
        "target_rates",
        "landscape",
        "train",
        "track",
        "batch",
        "command",
    ]


def test_what_does_not_fit_into_memory_is_measured_with_fewer_starts(monkeypatch):
    monkeypatch.setattr(all_rows.machine, "available", lambda: 5e9)
    found = all_rows.step(64, 7, 500)
    assert found.plans["torch"].num_starts == 12 and found.plans["torch"].scale == 64 / 12
    assert found.plans["torch"].note == "12 starts, the most that fit into memory; time x 64/12"
    assert found.plans["tdf_jax"].num_starts is None and found.plans["tdf_jax"].scale == 1
