"""`tdf env`: versions, devices and fingerprints as they are, also where something is missing or damaged."""

import importlib.metadata
import json
import re
from pathlib import Path

import jax
import pytest

import tdf_jax as tdf
from tdf_jax.cli.main import main
from tdf_jax.networks.model import fingerprint

TEMPLATE = Path(__file__).parents[2] / ".github" / "ISSUE_TEMPLATE" / "bug.md"


@pytest.fixture
def record(capsys):
    def record():
        main(["env", "--json"])
        return json.loads(capsys.readouterr().out)

    return record


def test_json_says_what_is_installed_and_which_weights_are_shipped(record, monkeypatch):
    monkeypatch.setenv("JAX_ENABLE_X64", "0")
    about = record()
    assert about["tdf_jax"] == tdf.__version__
    assert about["requirements"]["core"]["jax"] == jax.__version__
    assert about["requirements"]["mesh"] == {"libigl": importlib.metadata.version("libigl")}
    assert len(about["devices"]) == len(jax.devices()) and about["devices"][0].startswith("cpu")
    assert about["environment"]["JAX_ENABLE_X64"] == "0"
    assert tuple(about["weights"]) == tdf.available_models()
    assert about["weights"]["bowl"] == fingerprint(tdf.load_model("bowl"))
    assert len(set(about["weights"].values())) == len(about["weights"])


def test_the_table_has_a_line_for_each(capsys):
    main(["env"])
    lines = dict(re.split(r"  +", line, maxsplit=1) for line in capsys.readouterr().out.splitlines())
    assert lines["tdf_jax"].startswith(f"{tdf.__version__}, ")
    assert lines["devices"].startswith("cpu")
    assert re.fullmatch("[0-9a-f]{16}", lines["weights mug"])


def test_damaged_weights_and_missing_devices_are_said(record, monkeypatch, tmp_path):
    (tmp_path / "odd.safetensors").write_bytes(b"no weights")
    monkeypatch.setattr("tdf_jax.networks.checkpoint._shipped", lambda: {"odd": tmp_path / "odd.safetensors"})
    assert re.match(r"load_model\(\): .*odd.safetensors is not a valid safetensors file", record()["weights"]["odd"])
    monkeypatch.setattr("tdf_jax.cli.env.platform_problem", lambda: "JAX has no device")
    about = record()
    assert about["devices"] == about["weights"]["odd"] == "JAX has no device"


def test_a_missing_requirement_is_said(record, capsys, monkeypatch):
    version = importlib.metadata.version

    def without_libigl(name):
        if name == "libigl":
            raise importlib.metadata.PackageNotFoundError(name)
        return version(name)

    monkeypatch.setattr(importlib.metadata, "version", without_libigl)
    assert record()["requirements"]["mesh"] == {"libigl": None}
    main(["env"])
    assert re.search(r"^mesh +not installed: libigl$", capsys.readouterr().out, re.MULTILINE)


def test_version(capsys):
    main(["--version"])
    assert capsys.readouterr().out == f"{tdf.__version__}\n"


def test_the_bug_report_asks_for_it():
    assert "`tdf env`" in TEMPLATE.read_text()
