"""The command line of the studies: defaults, and mistakes that end it before any work."""

import importlib

import pytest

from tdf_jax.evaluation.study_command import file_to_write, study_parser


@pytest.fixture
def parser():
    made = study_parser("my.study", "What is measured.\n\nAnd how.", "mugs", 7, "number of mugs", "the mugs")
    made.add_argument("--out", type=file_to_write)
    return made


def test_numbers_have_defaults_that_the_help_names(parser):
    found = parser.parse_args(["--mugs", "3"])
    assert (found.mugs, found.seed, found.out) == (3, 0, None)
    text = " ".join(parser.format_help().split())
    assert text.startswith("usage: python -m my.study") and "And how" not in text
    assert "number of mugs (default: 7)" in text and "seed of the mugs (default: 0)" in text


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["--mugs", "0"], "argument --mugs: 0 is given; expected at least 1"),
        (["--seed", "-1"], "argument --seed: -1 is given; expected at least 0"),
        (["--mugs", "many"], "argument --mugs: invalid whole number value: 'many'"),
        (["--out", "missing/out.json"], "argument --out: missing/out.json is given; expected a file in an existing"),
        (["--out", "."], "argument --out: . is given; expected a file in an existing folder"),
    ],
)
def test_mistakes_are_refused(parser, words, message, capsys, monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(SystemExit) as stopped:
        parser.parse_args(words)
    assert stopped.value.code == 2 and message in capsys.readouterr().err


STUDIES = {
    "evaluation.confidence_study": "picks",
    "evaluation.foreign_study": "pairs",
    "evaluation.sensitivity_study": "pairs",
    "evaluation.tracking_study": "moves",
    "evaluation.view_study": "mugs",
    "sim.approach_study": "objects",
    "sim.motion_study": "episodes",
    "sim.removal_study": "objects",
}


@pytest.mark.parametrize(("module", "counted"), STUDIES.items())
def test_every_study_refuses_mistakes_before_it_begins(module, counted, capsys, monkeypatch, tmp_path):
    study = importlib.import_module(f"tdf_jax.{module}")
    monkeypatch.chdir(tmp_path)
    out = ["--out", "missing/out.json"]  # a folder that is made, or a file in one that is not
    for words, message in (
        ([f"--{counted}", "0"], f"--{counted}: 0 is given; expected at least 1"),
        (["--seed", "-1"], "--seed: -1 is given; expected at least 0"),
    ):
        with pytest.raises(SystemExit) as stopped:
            study.main([*words, *out])
        assert stopped.value.code == 2 and message in capsys.readouterr().err
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("module", ["evaluation.foreign_study", "evaluation.view_study", "sim.removal_study"])
def test_studies_that_write_one_file_refuse_a_missing_folder(module, capsys, monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(SystemExit) as stopped:
        importlib.import_module(f"tdf_jax.{module}").main(["--out", "missing/out.json"])
    assert stopped.value.code == 2 and "expected a file in an existing folder" in capsys.readouterr().err
