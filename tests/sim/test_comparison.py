"""The page and the record of `tdf benchmark --simulation`, of outcomes that are known."""

import dataclasses
import json
import re
from typing import Any

import numpy as np
import pytest

from tdf_jax._internal.errors import InputError
from tdf_jax.sim.campaign import Run
from tdf_jax.sim.comparison import page, record
from tdf_jax.sim.condition import METHODS, Condition, Settings
from tdf_jax.sim.episode import Outcome
from tdf_jax.sim.physics import LIGHT_MASS
from tdf_jax.sim.published import NDF, Published, peers_of
from tdf_jax.sim.rows import TARGETS, Row, planned_rows
from tdf_jax.sim.sentences import reading
from tdf_jax.sim.tasks import TASKS

GOOD = Outcome(True, True, True, True, "", "", 0.002, 1.0)
SLACK = Outcome(True, True, True, False, "not on the peg", "no peg", 0.004, 3.0)
SLIPPED = Outcome(False, True, False, False, "slipped", "20 mm", 0.02, 1.0)
FELL = Outcome(True, False, False, False, "fell", "it fell", 0.006, 5.0)
NEVER = Outcome(False, False, False, False, "unreachable", "far", np.nan, np.nan)
RACK = Condition("mug_on_rack", "known", "upright", "teleport")
SETTINGS = {
    "tasks": ("mug_on_rack",), "modes": ("teleport",), "targets": None, "pose": ("upright",), "clouds": ("full",),
    "methods": ("tdf_jax",), "demonstrations": (1,), "light": False, "episodes": 4, "seed": 3, "processes": 2,
}  # fmt: skip


@pytest.fixture
def row(tmp_path):
    """A row of outcomes under a condition that differs from `RACK` in some fields."""

    def make(*outcomes, **changes):
        condition = RACK._replace(**changes)
        runs = [Run(condition, n, one, n % 3, n % 2, (2.0 + n, 5.0, 15.0 + n)) for n, one in enumerate(outcomes)]
        return Row(Settings(condition, "mug", "rack", 3, tmp_path), runs)

    return make


def table(text, title):
    """Rows of the table below a heading, by column."""
    lines = [line for line in text.partition(f"{title}\n")[2].partition("\n#")[0].splitlines() if line[:1] == "|"]
    heads, _, *cells = [[cell.strip() for cell in line.strip("|").split(" | ")] for line in lines]
    return [dict(zip(heads, one, strict=True)) for one in cells]


# ---- which rows there are ----

ALL: dict[str, Any] = {
    "tasks": tuple(TASKS), "modes": ("teleport", "execute"), "targets": None, "poses": ("upright",),
    "clouds": ("full",), "methods": ("tdf_jax",), "demonstrations": (1,), "light": False,
}  # fmt: skip


def planned(**changes):
    used: dict[str, Any] = ALL | changes
    return planned_rows(**used)


def test_by_default_targets_are_those_of_the_published_protocols():
    rows = planned()
    assert {(row.task, row.target) for row in rows} == {(task, one) for task in TASKS for one in TARGETS[task]}
    assert len(rows) == 12 == len(set(rows)) and not any(row.mass for row in rows)
    assert {row.task for row in rows if row.mode == "teleport" and not peers_of(row)} == set()


def test_only_what_can_be_measured_is_combined():
    rows = planned(targets=("known", "found"), demonstrations=(1, 10), methods=METHODS)
    assert {row.target for row in rows if TASKS[row.task].target == "board"} == {"known"}
    ten = [row for row in rows if row.demonstrations == 10]
    assert {(row.target, row.method) for row in ten} == {("found", "tdf_jax")} and len(ten) == 3 * 2


def test_meshes_are_beside_generated_objects():
    rows = planned(objects=("generated", "meshes"))
    assert len(rows) == 24 and {row.objects for row in rows} == {"generated", "meshes"}


def test_only_teleported_objects_are_light():
    rows = planned(light=True)
    assert {(row.mode, row.mass) for row in rows} == {("teleport", LIGHT_MASS), ("execute", 0.0)}


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"clouds": ()}, "--clouds is empty; expected at least one"),
        ({"tasks": ("bowl_on_shelf",), "targets": ("found",)}, "--targets has 'found', for which there is no row"),
        ({"masks": ("simulator",)}, "--masks has 'simulator', for which there is no row"),
        ({"targets": ()}, "--targets is empty; expected at least one"),
        ({"tasks": ("bowl_on_shelf",), "targets": ("known", "found")}, "--targets has 'found', for which there is no"),
        ({"tasks": ("bowl_on_shelf", "bowl_on_mug"), "targets": ("found",)}, "--tasks has 'bowl_on_shelf'"),
        ({"tasks": ("bowl_on_shelf",), "demonstrations": (1, 10)}, "--demonstrations has 10"),
        ({"tasks": ("bowl_on_mug",), "demonstrations": (10,), "methods": ("tdf_jax", "ICP")}, "--methods has 'ICP'"),
    ],
)
def test_a_value_without_a_row_is_refused(changes, message):
    with pytest.raises(InputError, match=re.escape(message)):
        planned(**changes)


# ---- published rates ----


def test_published_rates_stand_beside_rows_of_the_same_protocol():
    assert peers_of(RACK) == [
        Published("NDF", 10, 0.96, 0.92, 0.88), Published("NDF", 1, None, None, 0.46),
        Published("L-NDF", 10, None, None, 0.995),
    ]  # fmt: skip
    found = peers_of(RACK._replace(target="found", poses="tilt60"))
    assert found == [Published("R-NDF", 10, None, 0.75, None), Published("R-NDF", 1, None, 0.44, None)]
    assert peers_of(RACK._replace(mode="execute")) == peers_of(RACK._replace(poses="uniform")) == []


def test_a_published_overall_rate_is_at_most_its_parts():
    for rates in (one for task in NDF.values() for one in task.values()):
        assert rates[2] <= min(rates[:2])


# ---- the page ----


def test_a_table_has_rates_with_intervals_beside_published_ones(row):
    text = page([row(GOOD, SLACK, FELL, SLIPPED), row(GOOD, GOOD, method="ICP")], SETTINGS)
    ours, icp = table(text, "### Teleported: mug on rack")
    assert ours["method"] == "**tdf_jax**" and ours["episodes"] == "4" and ours["shown"] == "1"
    for name, share in (("grasp", 75), ("place", 75), ("overall", 50), ("overall, hung by the handle", 25)):
        ((rate, low, high),) = re.findall(r"^(\d+) % \((\d+) to (\d+)\)$", ours[name])
        assert int(rate) == share and int(low) < share < int(high)
    assert ours["NDF: grasp / place / overall"] == "96 / 92 / 88 % (one: overall 46 %)"
    assert ours["L-NDF: overall"] == "99.5 %" and "R-NDF: place" not in ours
    assert icp["method"] == "ICP" and icp["overall"] == "100 % (100 to 100)"
    assert icp["NDF: grasp / place / overall"] == icp["L-NDF: overall"] == ""  # beside the library's


def test_relations_stand_beside_the_place_of_r_ndf(row):
    text = page([row(GOOD, FELL, task="bowl_on_mug", target="found", poses="tilt60")], SETTINGS)
    (one,) = table(text, "### Teleported: bowl on mug")
    assert one["R-NDF: place"] == "70 %" and "overall, hung by the handle" not in one and "### Executed" not in text


def test_executed_rows_stand_alone(row):
    (one,) = table(page([row(GOOD, GOOD, mode="execute")], SETTINGS), "### Executed: mug on rack")
    assert not any("NDF" in head for head in one)


def test_failures_draws_and_times_are_in_the_page(row):
    text = page([row(GOOD, FELL, NEVER, FELL, SLIPPED, mode="execute")], SETTINGS)
    (failed,) = table(text, "## Failures and draws")
    assert failed["failed"] == "4 of 5" and failed["causes"] == "fell 2, unreachable 1, slipped 1"
    assert failed["starts rejected"] == "4" and failed["pairs rejected"] == "2"  # 0, 1, 2, 0, 1 and 0, 1, 0, 1, 0
    assert failed["moved in the hand"] == "6.0 mm, 5.0°"  # of 2, 6, 6, 20 mm and 1, 5, 5, 1 degrees
    (times,) = table(text, "## Times")
    assert [times[name] for name in ("imitation", "planning", "physics")] == ["4.0", "5.0", "17.0"]
    assert times["all episodes, minutes"] == "2.2"  # 20, 25 and 85 s
    assert "imitation 15 %, planning 19 %, physics 65 %." in text


def test_criteria_of_the_place_stand_apart(row):
    placed = dataclasses.replace(GOOD, touches=True, off_table=True, settled=True, comes_off=True, hung=True)
    stuck = dataclasses.replace(FELL, touches=True, off_table=True, settled=True, hung=True)
    (one,) = table(page([row(placed, stuck)], SETTINGS), "## Criteria of the place")
    assert one["comes off upside down"] == "50 % (0 to 100)" and one["settled"] == "100 % (100 to 100)"
    assert one["upright"] == one["no collision"] == ""  # a mug that is teleported


def test_meshes_have_rows_of_their_own_beside_generated_objects(row):
    real = row(GOOD, FELL, GOOD, FELL, objects="meshes")
    runs = [dataclasses.replace(one, instance=("cup", "jug")[n % 2]) for n, one in enumerate(real.all)]
    lost = dataclasses.replace(runs[1], number=4, outcome=Outcome.failure("not drawn", "too thick"))
    real = Row(real.settings, [*runs, lost])
    text = page([row(*[GOOD] * 40), real], SETTINGS)
    ours, theirs = table(text, "### Teleported: mug on rack")
    assert (ours["poses"], theirs["poses"]) == ("upright", "upright, meshes") and theirs["episodes"] == "4"
    assert theirs["overall"] == "50 % (0 to 100)"
    assert (
        "40 episodes a row, each with an unseen generated object; rows of meshes have episodes of cup, jug in turn"
        in text
    )
    assert "- Not drawn, and not counted: 4: jug: too thick." in text
    assert "above it in 0 of 1 rows" in text  # published rates are compared with generated objects alone
    assert real.likely("overall") == (0, 1) and record([real], SETTINGS)["rows"][0]["not_drawn"] == [4]


def test_a_row_of_which_nothing_was_drawn_says_so(row):
    text = page([row(GOOD, GOOD), row(*[Outcome.failure("not drawn", "far")] * 2, poses="tilt60")], SETTINGS)
    _, empty = table(text, "### Teleported: mug on rack")
    assert empty["episodes"] == "0" and empty["overall"] == "n/a"
    assert "- Not drawn, and not counted: 0, 1: far." in text
    assert "![The first failed" not in text
    assert "![The first failed episode of each cause](a.png)" in page([row(GOOD)], SETTINGS, "a.png")


def test_nothing_held_is_no_movement(row):
    (failed,) = table(page([row(NEVER, NEVER)], SETTINGS), "## Failures and draws")
    assert failed["moved in the hand"] == ""


def test_the_page_says_which_command_made_it(row):
    text = page([row(GOOD, GOOD)], SETTINGS | {"light": True, "methods": ("tdf_jax", "rigid replay")})
    assert (
        "`tdf benchmark --simulation --tasks mug_on_rack --modes teleport --pose upright --clouds full --methods "
        "tdf_jax 'rigid replay' --demonstrations 1 --light --episodes 4 --seed 3` made this page" in text
    )
    assert "same protocol, other objects" in text and "(simulation/simulation.json)" in text


# ---- the reading ----


def test_the_reading_compares_rows_that_differ_in_one_thing(row):
    rows = [
        row(GOOD, GOOD, GOOD, GOOD, mass=LIGHT_MASS),
        row(GOOD, GOOD, GOOD, FELL, mode="execute"),
        row(FELL, FELL, GOOD, GOOD, poses="tilt60", mass=LIGHT_MASS),
        row(FELL, FELL, FELL, FELL, method="ICP", mass=LIGHT_MASS),
        row(GOOD, GOOD, GOOD, GOOD, mode="execute", method="truth"),
    ]
    text = "\n".join(reading(rows))
    assert (  # whatever the masses
        "Executed instead of teleported, and objects with masses by their volume: overall success is lower by 25.0 "
        "points"
    ) in text
    assert "instead of upright: overall success is lower by 50.0 points" in text
    assert (
        "The library instead of ICP: overall success is higher by 100.0 points, 95 % interval +100.0 to +100.0" in text
    )
    assert "instead of the true pick and release: overall success is lower by 25.0 points" in text
    assert "(1 pair of rows, the same episodes)" in text
    assert "Causes of failure in 8 teleported episodes of the library: fell 2." in text
    tilted = re.search("Starts tilted.*", text)
    assert tilted and "(1 pair of rows)" in tilted[0]  # the starts are others
    assert "three cameras" not in text and "Ten demonstrations" not in text  # of which there are no rows


def test_no_change_is_said_to_be_none_and_one_point_is_one(row):
    same = [row(GOOD, FELL), row(GOOD, FELL, clouds="views3")]
    assert "complete ones: overall success is the same, 95 % interval +0.0 to +0.0" in "\n".join(reading(same))
    less = [row(*[GOOD] * 100), row(*[GOOD] * 99, FELL, clouds="views3")]
    assert "overall success is lower by 1.0 point, 95 % interval -3.0 to +0.0" in "\n".join(reading(less))


def test_the_reading_says_where_published_rates_lie(row):
    rows = [row(*[GOOD] * 40), row(*[FELL] * 40, poses="tilt60"), row(*[GOOD, GOOD, FELL] * 2, target="found")]
    text = "\n".join(reading(rows))
    assert re.search(
        r"- NDF, overall: the published rate is below our interval in 1, in it in 0 and above it in 1 of 2 rows", text
    )
    assert re.search(
        r"- R-NDF, place: the published rate is below our interval in 0, in it in 1 and above it in 0 of 1 rows", text
    )


def test_equal_outcomes_do_not_make_a_rate_certain(row):
    assert row(*[GOOD] * 40).likely("overall") == pytest.approx((0.925, 1))
    assert row(*[FELL] * 40).likely("overall") == pytest.approx((0, 0.075))
    assert row(GOOD, GOOD).likely("overall") == (0, 1) == row(GOOD).likely("overall")
    mixed = row(GOOD, FELL, GOOD)
    assert mixed.likely("overall") == tuple(mixed.rates["overall"][1])
    # L-NDF's 99.5 % is no less than 40 of 40
    assert (
        "- L-NDF, overall: the published rate is below our interval in 0, in it in 1" in reading([row(*[GOOD] * 40)])[1]
    )


def test_few_episodes_are_said_to_be_few(row):
    assert "Rows of 2 episodes" in "\n".join(reading([row(GOOD, GOOD), row(*[GOOD] * 40, poses="tilt60")]))
    assert "Rows of" not in "\n".join(reading([row(*[GOOD] * 40)]))


def test_a_row_without_a_failure_and_without_a_peer_has_only_the_general_truth(row):
    (only,) = reading([row(*[GOOD] * 40, mode="execute")])
    assert only.startswith("Teleport tests the grasp and the placement apart")


# ---- the record ----


def test_a_record_is_the_same_on_a_rerun_but_for_times_and_the_machine(row):
    rows = [row(GOOD, NEVER), row(GOOD, FELL, poses="tilt60")]
    made = json.loads(json.dumps(record(rows, SETTINGS), allow_nan=False))
    assert [one["condition"]["poses"] for one in made["rows"]] == ["upright", "tilt60"]
    first = made["rows"][0]
    assert first["rates"]["overall"]["rate"] == 0.5 and first["published"][0]["overall"] == 0.88
    assert first["number_of_episodes"] == 2 and (first["rejected"], first["redrawn"]) == (1, 1)
    assert first["moved_in_hand_median"] == {"metres": 0.002, "degrees": 1.0}
    assert first["episodes"][1]["cause"] == "unreachable" and made["settings"]["seed"] == 3
    for one in rows:
        one.all[:] = [
            Run(run.condition, run.number, run.outcome, run.rejected, run.redrawn, (9.0, 9.0, 9.0)) for run in one.runs
        ]
    again = json.loads(json.dumps(record(rows, SETTINGS)))
    assert {key for key in made if made[key] != again[key]} == {"seconds"}
