"""A wheel, installed elsewhere, is complete. Pip fetches the build backend from the package index for it."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

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
def installed(tmp_path_factory):
    """The folder that a fresh wheel is installed to."""
    built, target = tmp_path_factory.mktemp("wheel"), tmp_path_factory.mktemp("installed")
    run(*PIP, "wheel", ROOT, "--no-deps", "--wheel-dir", built)
    (wheel,) = built.glob("tdf_jax-*.whl")
    run(*PIP, "install", wheel, "--no-deps", "--target", target)
    return target


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
