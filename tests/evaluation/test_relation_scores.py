"""The benchmark of relations: what is kept, baselines against known motions, rates and the page."""

import json

import numpy as np
import pytest

from tdf_jax._internal.errors import InputError
from tdf_jax.evaluation import relation_scores as scores
from tdf_jax.evaluation.relation_report import PUBLISHED, page, record, row
from tdf_jax.evaluation.relation_scores import LIBRARY, METHODS, Condition, Networks, Score, run
from tdf_jax.evaluation.relation_success import Placed

BOTTLE = Condition("bottle_in_container", "upright", "full", 1)
GOOD = Placed(gap=0.001, penetration=0.0, tilt=2.0, hung=True, supported=True)
BAD = {
    "gap": Placed(0.003, 0.0, 2.0, True, True),
    "penetration": Placed(0.0, np.inf, 2.0, True, True),
    "tilt": Placed(0.0, 0.0, 16.0, True, True),
    "hung": Placed(0.0, 0.0, np.nan, False, True),
    "support": Placed(0.0, 0.0, 2.0, True, False),
}


@pytest.mark.parametrize("reason", BAD)
def test_every_part_of_the_verdict_counts(reason):
    assert GOOD.holds() and not BAD[reason].holds()
    assert BAD[reason].holds(0.005) == (reason == "gap")


def canned(placed, method=LIBRARY):
    return [Score(method, BOTTLE, i, i * 10 // len(placed), one, 2.0, np.eye(4)) for i, one in enumerate(placed)]


def test_rates_intervals_and_the_spread_over_demonstrations():
    several = [GOOD] * 15 + [BAD["gap"]] * 5
    found = row(canned(several))
    assert found["success_2mm"] == found["gap_2mm"] == 0.75 and found["success_5mm"] == 1.0
    assert found["interval_2mm"][0] < 0.75 < found["interval_2mm"][1]
    assert found["success_of_each_demonstration"] == [1.0] * 7 + [0.5] + [0.0] * 2
    assert found["pairs"] == 20 and found["seconds_median"] == 2.0


def test_the_page_and_the_record(small_model):
    both = canned([GOOD] * 3 + [BAD["penetration"]]) + canned([BAD["gap"]] * 4, "ICP")
    settings, redrawn = {"seed": 3, "pairs": 4}, {"bottle_in_container": 2}
    text = page(both, settings, redrawn)
    assert "2 of bottle in container" in text and "## Bottle in container" in text
    line = next(line for line in text.splitlines() if "| tdf_jax |" in line)
    assert "75 % (25 to 100)" in line and f"| {100 * PUBLISHED['bottle_in_container']['upright']:.0f} % |" in line
    assert "| ICP | 4 | 0 %" in text
    found = json.loads(json.dumps(record(both, {BOTTLE.task: Networks(small_model, small_model)}, settings, redrawn)))
    assert [one["method"] for one in found["rows"]] == ["tdf_jax", "ICP"]
    assert len(found["placements"]) == 8 and found["placements"][3]["penetration"] is None


def test_a_run_keeps_what_it_has_and_continues(small_model, tmp_path, monkeypatch):
    """A baseline needs no network; the second run computes the added pair only."""
    judged = []

    def verdict(pair, T):
        judged.append(pair.number)
        return GOOD

    monkeypatch.setattr(scores, "judge", verdict)
    networks = {BOTTLE.task: Networks(small_model, small_model)}

    def places(pairs):
        settings = {"pairs": pairs, "seed": 5, "progress": False}
        return list(run([BOTTLE], networks, ["centroids"], tmp_path, **settings))

    assert [one.method for one in places(1)] == ["centroids"] and judged == [0]
    # Each of the ten demonstrates for a tenth of the pairs, however many there are.
    assert [one.demonstrated for one in places(3)] == [0, 1, 2] and judged == [0, 1, 2]
    with pytest.raises(InputError, match="methods is 'magic'; expected one of tdf_jax"):
        list(run([BOTTLE], networks, ["magic"], tmp_path, pairs=1))
    assert set(METHODS) > {"ICP", "centroids"}


@pytest.mark.slow
def test_a_baseline_repeats_a_demonstration_of_the_same_objects(small_model, monkeypatch):
    """Test pair and demonstration are one, upright: the offset of the centroids is the truth up to the yaw."""
    monkeypatch.setattr(scores, "FIRST_DEMONSTRATION", 0)
    demonstrators = scores._Demonstrators(BOTTLE.task, Networks(small_model, small_model), 5)
    attempts = scores._Attempts(BOTTLE, 0, 0, Networks(small_model, small_model), demonstrators, 5)
    for method in ("centroids", "ICP"):
        found = attempts.of(method)
        placed = attempts._placement.placed(found["motion"])
        np.testing.assert_allclose(placed[:3, 3], attempts._placement.pair.T_target_object[:3, 3], atol=0.006)
        assert found["tilt"] < 3 and found["seconds"] >= 0
