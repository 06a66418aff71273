"""The notebooks run in their fast mode, show pictures, and are kept without outputs."""

import json
import sys
from pathlib import Path

import pytest
from conftest import quick_environment

ROOT = Path(__file__).parent.parent
FOLDER = ROOT / "notebooks"
NOTEBOOKS = sorted(FOLDER.glob("*.ipynb"))
sys.path.append(str(ROOT / "docs"))  # for `executed_notebooks`, which the site uses too

notebooks = pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)


def read(path):
    return json.loads(path.read_text())


def test_there_are_eight():
    assert [path.name[:2] for path in NOTEBOOKS] == ["01", "02", "03", "04", "05", "06", "07", "08"]


@pytest.mark.slow
@notebooks
def test_runs_and_shows_a_picture(path):
    from executed_notebooks import NEEDS, execute, keep

    for module in NEEDS.get(path.stem, ()):
        pytest.importorskip(module, reason="the extra 'sim' is not installed")
    before = sorted(FOLDER.rglob("*"))
    # Nearly all of the time is compilation, which is shorter so; see conftest. A cell that raises ends it.
    notebook = execute(path, quick_environment())
    outputs = [output for cell in notebook.cells for output in cell.get("outputs", ())]
    assert any("image/png" in output.get("data", {}) for output in outputs)
    assert sorted(FOLDER.rglob("*")) == before
    keep(path, notebook)  # `make docs` shows it


@notebooks
def test_is_kept_without_outputs(path):
    notebook = read(path)
    assert notebook["nbformat"] == 4
    assert set(notebook["metadata"]) == {"kernelspec", "language_info"}
    for cell in notebook["cells"]:
        assert not cell["metadata"]
        if cell["cell_type"] == "code":
            assert cell["outputs"] == [] and cell["execution_count"] is None


@notebooks
def test_begins_with_a_heading_and_the_goal(path):
    first, code, *_ = read(path)["cells"]
    heading, goal = "".join(first["source"]).split("\n\n")[:2]
    assert first["cell_type"] == "markdown" and heading.startswith("# ")
    assert goal.startswith("You ") and "minute" in goal
    assert code["cell_type"] == "code" and 'FAST = "TDF_FAST" in os.environ' in "".join(code["source"])
