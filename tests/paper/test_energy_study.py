"""The comparison of the solver's energies with Adam's: what it keeps, goes on with and tells."""

import dataclasses
import json

import numpy as np
import pytest

import tdf_jax as tdf
from tdf_jax.paper import energy_study as energies


@pytest.mark.slow
def test_it_keeps_what_is_done_and_tells_the_distribution(small_model, tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(
        energies,
        "load_model",
        lambda name: dataclasses.replace(small_model, info=tdf.ModelInfo("small", "a test", cloud_points=40)),
    )
    monkeypatch.setattr(energies, "QUERIES", 8)
    short = tdf.OptimizeConfig(num_starts=2, iterations=3)
    compared, kept = [], energies.compare

    def compare(problem, seed):
        compared.append(problem)
        return kept(problem._replace(config=short), seed)

    monkeypatch.setattr(energies, "compare", compare)
    words = ["--rows", "1", "--first", "3", "--out", str(tmp_path / "energies.json")]
    assert energies.main(["--pairs", "1", *words]) == 0
    assert energies.main(["--pairs", "2", *words]) == 0
    found = json.loads((tmp_path / "energies.json").read_text())
    assert list(found) == ["row 0, seed 0", "pair 3, seed 0", "pair 4, seed 0"] and len(compared) == 3
    ratios = [one["solve"]["energy"] / one["adam"]["energy"] for one in found.values()]
    assert all(np.isfinite(ratios)) and max(ratios) < 1.05  # three steps of Adam are not far
    lines = capsys.readouterr().out.splitlines()[-2:]
    assert lines[0].startswith(f"1 rows, energy of solve over Adam's: mean {ratios[0]:.4f}")
    assert lines[1].startswith(
        f"2 pairs, energy of solve over Adam's: mean {np.mean(ratios[1:]):.4f}; 0 %: {min(ratios[1:]):.4f}"
    )
    (tmp_path / "energies.json").write_text("{")
    assert energies.main(words) == 2
