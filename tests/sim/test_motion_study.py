"""The study of the planner: its search for configurations, its table, and one task end to end."""

import dataclasses

import pytest

from tdf_jax.sim import motion_study
from tdf_jax.sim.collision import Collisions
from tdf_jax.sim.motion_study import Row, main, plan_task, reachable, table_of
from tdf_jax.sim.workcell import build_workcell


def of(episode, robot):
    return Collisions(build_workcell(robot, episode.object_body, None, episode.target_body, None, fixed_target=False))


def test_what_the_draws_reach_is_reachable_and_what_is_far_or_in_the_table_is_not(robot, drawn):
    episode = drawn("bowl_on_shelf")
    collisions = of(episode, robot)
    assert reachable(episode, robot, collisions)

    for move in ((1.5, 0, 0), (0, 0, -0.15)):
        T = episode.T_world_target.copy()
        T[:3, 3] += move
        assert not reachable(dataclasses.replace(episode, T_world_target=T), robot, collisions)


@pytest.mark.slow
def test_a_task_is_planned(robot):
    row = plan_task(robot, "bowl_on_shelf", "upright", 900, 0)
    assert row.solved and not row.reason and row.seconds > 0 and (row.task, row.number) == ("bowl_on_shelf", 0)


def test_the_table_has_shares_and_times_of_each_task_and_of_all():
    rows = [Row("mug_on_rack", "upright", n, 0, n > 0, "" if n else "no", float(n)) for n in range(4)]
    lines = table_of([*rows, Row("bowl_on_mug", "tilt60", 0, 0, True, "", 9.0)]).splitlines()
    assert lines[2].startswith("| mug on rack upright | 4 | 75 % (25 to 100) | 1.50 s |")
    assert lines[3].startswith("| bowl on mug tilt60 | 1 | 100 % | 9.00 s |") and lines[4].startswith(
        "| all | 5 | 80 %"
    )


def test_the_command_says_reasons_and_continues_where_it_stopped(monkeypatch, capsys, tmp_path):
    planned = []

    def plan(robot, task, poses, seed, number):
        if len(planned) == 1:
            planned.append("stop")
            raise KeyboardInterrupt
        planned.append(number)
        return Row(task, poses, number, 0, number > 0, "" if number else "the reason", 0.5)

    monkeypatch.setattr(motion_study, "plan_task", plan)
    monkeypatch.setattr(motion_study, "load_robot", lambda file, site: None)
    words = ["--episodes", "2", "--tasks", "bowl_on_mug", "--poses", "tilt60", "--out", str(tmp_path / "kept")]
    with pytest.raises(KeyboardInterrupt):
        main(words)
    for _ in range(2):
        capsys.readouterr()
        main(words)
        printed = capsys.readouterr().out
        assert "bowl_on_mug tilt60 0: the reason" in printed and "| all | 2 | 50 % (0 to 100) | 0.50 s |" in printed
    assert planned == [0, "stop", 1] and len(list((tmp_path / "kept").iterdir())) == 2
    main([*words, "--seed", "1"])
    assert planned == [0, "stop", 1, 0, 1]


@pytest.mark.parametrize(
    "words, message",
    [
        (["--out", "file"], "file"),
        (["--out", "kept", "--robot", "missing.xml", "--site", "grip"], "missing.xml"),
        (["--out", "kept", "--episodes", "0"], "--episodes: 0 is given; expected at least 1"),
        (["--out", "kept", "--seed", "-1"], "--seed: -1 is given"),
        (["--out", "kept", "--tasks", "nothing"], "nothing"),
    ],
)
def test_mistakes_are_refused_before_the_work(words, message, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "file").write_text("mine")
    monkeypatch.setattr(motion_study, "plan_task", lambda *about: pytest.fail("it plans"))
    with pytest.raises(SystemExit) as stop:
        main(words)
    assert stop.value.code == 2 and message in capsys.readouterr().err
