"""A wheel, installed elsewhere, is complete. Pip fetches the build backend from the package index for it."""

import os
import re
import subprocess
import sys
import tomllib
import zipfile
from pathlib import Path

import pytest

import tdf_jax as tdf

ROOT = Path(__file__).parent.parent
PIP = (sys.executable, "-m", "pip", "--disable-pip-version-check", "--quiet")
CHECK = """
from importlib import metadata, resources
import tdf_jax as tdf
print(tdf.__file__)
print((resources.files("tdf_jax") / "py.typed").is_file())
print(metadata.version("tdf_jax") == tdf.__version__)
print(tdf.load_model("mug").info.name, *tdf.available_models())
"""


def run(*command, **options):
    done = subprocess.run(command, capture_output=True, text=True, **options)
    assert done.returncode == 0, f"{' '.join(map(str, command))}\n{done.stdout}{done.stderr}"
    return done.stdout


@pytest.fixture(scope="module")
def wheel(tmp_path_factory):
    built = tmp_path_factory.mktemp("wheel")
    run(*PIP, "wheel", ROOT, "--no-deps", "--wheel-dir", built)
    (wheel,) = built.glob("tdf_jax-*.whl")
    return wheel


@pytest.fixture(scope="module")
def installed(wheel, tmp_path_factory):
    """The folder that a fresh wheel is installed to."""
    target = tmp_path_factory.mktemp("installed")
    run(*PIP, "install", wheel, "--no-deps", "--target", target)
    return target


def test_a_source_distribution_holds_what_its_tests_read():
    """Its tests can be run where it is unpacked."""
    settings = tomllib.loads((ROOT / "pyproject.toml").read_text())
    held = settings["tool"]["hatch"]["build"]["targets"]["sdist"]["include"]
    sources = "".join(path.read_text() for path in (ROOT / "tests").rglob("*.py"))
    read = set(re.findall(r'(?:\bROOT|parents\[2\]|parent\.parent) / "([^"/*]+)"', sources)) - {"pyproject.toml"}
    assert {"docs", ".github"} <= read <= set(held)


@pytest.mark.slow
def test_a_wheel_holds_code_and_weights_under_the_licence_and_nothing_else(wheel):
    """docs/installation.md says its size, and that nothing in it is another project's."""
    with zipfile.ZipFile(wheel) as archive:
        names = archive.namelist()
        (metadata,) = (archive.read(name).decode() for name in names if name.endswith(".dist-info/METADATA"))
    about = r"tdf_jax-[\w.]+\.dist-info/(METADATA|RECORD|WHEEL|entry_points\.txt|licenses/LICENSE)"
    known = rf"tdf_jax/(\w+/)*\w+\.py|tdf_jax/py\.typed|tdf_jax/weights/\w+\.(safetensors|md)|{about}"
    assert [name for name in names if not re.fullmatch(known, name)] == []
    assert sum(name.endswith("licenses/LICENSE") for name in names) == 1
    assert f"Version: {tdf.__version__}\n" in metadata and "License-Expression: MIT\n" in metadata
    assert wheel.stat().st_size < 41e6


@pytest.mark.slow
def test_an_installed_wheel_holds_code_weights_and_type_marker(installed, tmp_path):
    environment = os.environ | {"PYTHONPATH": str(installed)}
    file, *rest = run(sys.executable, "-c", CHECK, cwd=tmp_path, env=environment).splitlines()
    assert Path(file).is_relative_to(installed)
    assert rest == ["True", "True", "mug bottle bowl container mug multi rack"]


@pytest.mark.slow
def test_its_command_line_runs(installed, tmp_path):
    environment = os.environ | {"PYTHONPATH": str(installed)}
    assert "--target" in run(installed / "bin" / "tdf", "imitate", "--help", cwd=tmp_path, env=environment)
