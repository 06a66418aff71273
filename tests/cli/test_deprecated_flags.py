"""Options of the release before: they still work, with a warning on stderr."""

import pytest

from tdf_jax.cli import main as command_line

FLAGS = [(command, old, new) for command, flags in command_line.DEPRECATED_FLAGS.items() for old, new in flags.items()]


@pytest.mark.parametrize("command", command_line.DEPRECATED_FLAGS)
def test_the_help_has_the_new_names_alone(command, capsys):
    with pytest.raises(SystemExit) as stop:
        command_line.main([command, "--help"])
    assert stop.value.code == 0
    words = capsys.readouterr().out.replace(",", " ").split()
    for old, new in command_line.DEPRECATED_FLAGS[command].items():
        assert new in words and old not in words


@pytest.mark.parametrize(("command", "old", "new"), FLAGS)
def test_an_old_name_stands_for_the_new_one_with_a_warning(command, old, new, capsys):
    for words, current in (([old, "3"], [new, "3"]), ([f"{old}=3"], [f"{new}=3"])):
        assert command_line._current([command, "--seed", "1", *words]) == [command, "--seed", "1", *current]
        assert capsys.readouterr().err == f"tdf: warning: {old} is deprecated; use {new}\n"


@pytest.mark.parametrize("command", ["benchmark", "evaluate"])
def test_an_old_name_sets_the_option(command, capsys):
    with pytest.raises(SystemExit) as stop:
        command_line.main([command, "--poses", "0"])
    assert stop.value.code == 2
    assert capsys.readouterr().err.splitlines() == [
        "tdf: warning: --poses is deprecated; use --num-poses",
        f"tdf: error: tdf {command}: --num-poses is 0; expected a whole number of at least 1",
    ]


def test_new_names_have_no_warning(capsys):
    words = ["evaluate", "--num-starts", "3"]
    assert command_line._current(words) == words and capsys.readouterr().err == ""


@pytest.mark.parametrize(("old", "new"), [("least", "min"), ("soft_least", "softmin")])
def test_an_old_choice_stands_for_the_new_one_with_a_warning(old, new, capsys):
    for words, current in ((["--reduce", old], ["--reduce", new]), ([f"--reduce={old}"], [f"--reduce={new}"])):
        assert command_line._current(["landscape", *words, "--json"]) == ["landscape", *current, "--json"]
        assert capsys.readouterr().err == f"tdf: warning: --reduce {old} is deprecated; use --reduce {new}\n"
    for words in (["imitate", "--reduce", old], ["landscape", "--out", old]):
        assert command_line._current(words) == words and capsys.readouterr().err == ""


def test_the_old_energy_of_a_field_stands_for_the_new_one_with_a_warning(capsys):
    with pytest.raises(SystemExit) as stop:
        command_line.main(["reproduce", "fig1", "--field-energy", "least", "--trajectory", "wave", "--k", "-1"])
    assert stop.value.code == 2
    assert capsys.readouterr().err.splitlines()[0] == (
        "tdf: warning: --field-energy least is deprecated; use --field-energy min"
    )
    words = ["reproduce", "fig2", "--field-energy=mean"]
    assert command_line._current(words) == words and capsys.readouterr().err == ""


def test_a_switch_that_does_nothing_any_more_is_dropped_with_a_warning(capsys):
    assert command_line._current(["landscape", "--no-page", "--json"]) == ["landscape", "--json"]
    error = capsys.readouterr().err
    assert error == "tdf: warning: --no-page is deprecated and does nothing: a page is written with --page alone\n"
    assert command_line._current(["imitate", "--no-page"]) == ["imitate", "--no-page"]
