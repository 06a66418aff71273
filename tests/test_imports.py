"""Data flows one way: a module imports only from those before it. Heavy libraries load only when they are used."""

import ast
import subprocess
import sys
from pathlib import Path

import pytest

import tdf_jax

PACKAGE = Path(tdf_jax.__file__).parent
ORDER = """
    errors keys files precision poses symmetry trajectory paths query meshes pointcloud views network field model refinement obstacles clearance checkpoint torch_pickle convert
    descriptor demonstration recording energy devices descent confidence recognition optimize solve carry modes grid landscape lattice sweep route imitation
    shapes evaluation benchmark training viz experiments cli
""".split()
FILES = sorted(path.relative_to(PACKAGE) for path in PACKAGE.rglob("*.py") if path != PACKAGE / "__init__.py")


def layer(path: Path) -> str:
    return path.parts[0].removesuffix(".py")


def imported(path: Path) -> set[str]:
    """Layers that a file imports from, anywhere in it."""
    layers = set()
    for node in ast.walk(ast.parse((PACKAGE / path).read_text())):
        if isinstance(node, ast.Import):
            names = [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{path} line {node.lineno}: a relative import"
            below = node.module == "tdf_jax"
            names = [f"tdf_jax.{alias.name}" for alias in node.names] if below else [node.module]
        else:
            continue
        layers |= {name.split(".")[1] if "." in name else "" for name in names if name.split(".")[0] == "tdf_jax"}
    return layers


@pytest.mark.parametrize("path", FILES, ids=str)
def test_a_module_imports_only_from_those_before_it(path):
    assert layer(path) in ORDER, f"say where {path} stands in ORDER"
    allowed = set(ORDER[: ORDER.index(layer(path))])
    if len(path.parts) > 1:
        allowed.add(layer(path))  # files of one folder
    if layer(path) == "cli":
        allowed.add("")  # the package itself imports most modules, so only the last layer may import it
    assert imported(path) <= allowed


def test_imports_inside_of_functions_are_found():
    """The check above would pass on a parser that sees none; the command line has imports of every kind."""
    command_line = set().union(*(imported(path) for path in FILES if layer(path) == "cli"))
    assert {"errors", "checkpoint", "evaluation"} <= command_line
    assert "poses" in imported(Path("trajectory.py"))


def test_importing_the_package_loads_no_plots_viewer_meshes_or_command_line():
    heavy = ["matplotlib", "tyro", "viser", "trimesh", "scipy.spatial"]
    check = f"import sys, tdf_jax; print(*(name for name in {heavy} if name in sys.modules))"
    done = subprocess.run([sys.executable, "-c", check], capture_output=True, text=True, check=True, cwd=PACKAGE.parent)
    assert done.stdout.split() == []


def test_importing_the_package_changes_no_setting_of_jax():
    check = "import jax; before = dict(jax.config.values); import tdf_jax; assert dict(jax.config.values) == before"
    subprocess.run([sys.executable, "-c", check], check=True, cwd=PACKAGE.parent)
