"""MuJoCo's own viewer on a cell while it runs."""

import copy
import importlib
import os
import platform
import queue
import threading
import time
import warnings
from typing import Any

from tdf_jax._internal.errors import InputError
from tdf_jax.sim.physics import extra
from tdf_jax.sim.recording import AZIMUTH, CENTRE, DISTANCE, ELEVATION

RATE = 60.0  # updates in a second of simulated time
OPENING = 30.0  # seconds within which the window opens
INSTEAD = "--animation FILE films the same episode"


class Viewer:
    """Shows a cell in MuJoCo's viewer while it runs, at most as fast as the real time.

    The viewer has copies of the model and of the state, so that nothing that is done in its window changes the run.
    When the window is closed, the run goes on without it. Use it as a context manager, or close it.
    """

    def __init__(self, model: Any):
        """Open the window.

        Args:
            model: the `mujoco.MjModel` of the cell.

        Raises:
            InputError: the window does not open; see also `check_display`.
        """
        self._mujoco = extra("Viewer", "mujoco")
        self._model = copy.copy(model)
        self._data = self._mujoco.MjData(self._model)
        self._next, self._began = 0.0, None
        self._window = _opened(self._model, self._data)
        with self._window.lock():
            camera = self._window.cam
            camera.lookat[:], camera.distance = CENTRE, DISTANCE
            camera.azimuth, camera.elevation = AZIMUTH, ELEVATION

    def __enter__(self):
        return self

    def __exit__(self, *about):
        self.close()

    def close(self) -> None:
        """Close the window."""
        self._window.close()

    def watch(self, data: Any, step: int = 0, phase: str = "") -> None:
        """Show a state if it is time for it; call it after every step, as `execute(..., watch=)` does.

        Args:
            data: the state, whose time counts.
            step: not used.
            phase: not used.
        """
        if data.time < self._next - 1e-9 or not self._window.is_running():
            return
        self._next = max(self._next, data.time - 1e-9) + 1 / RATE
        with self._window.lock():
            self._mujoco.mj_copyData(self._data, self._model, data)
        self._window.sync()
        now = time.monotonic()
        if self._began is None:
            self._began = now - data.time
        time.sleep(max(0.0, self._began + data.time - now))


def check_display() -> None:
    """Raise InputError unless a window can be opened here.

    Raises:
        InputError: there is no display, its server does not answer, or this is macOS, whose windows belong to the first
            thread of a program.
    """
    if platform.system() == "Darwin":
        raise InputError(f"Viewer: on macOS no window opens beside a running simulation; {INSTEAD}")
    named = {name: os.environ.get(name) for name in ("DISPLAY", "WAYLAND_DISPLAY")}
    if platform.system() == "Linux" and not any(named.values()):
        raise InputError(
            f"Viewer: there is no display: neither {' nor '.join(named)} is set; run it on a desktop, or {INSTEAD}"
        )
    glfw = extra("Viewer", "glfw")
    with warnings.catch_warnings(record=True) as reasons:
        warnings.simplefilter("always")
        works = glfw.init()
        if works:
            glfw.terminate()
    if not works:
        why = "; ".join(str(one.message) for one in reasons) or "GLFW does not start"
        raise InputError(f"Viewer: no window opens on this display ({why}); run it on a desktop, or {INSTEAD}")


def _opened(model, data) -> Any:
    """The handle of MuJoCo's viewer, which would wait for ever if its window cannot be opened."""
    opened: queue.Queue = queue.Queue(1)

    def launch():
        try:
            launch_passive = importlib.import_module("mujoco.viewer").launch_passive
            opened.put(launch_passive(model, data, show_left_ui=False, show_right_ui=False))
        except Exception as error:  # every driver fails in its own way
            opened.put(error)

    threading.Thread(target=launch, daemon=True).start()
    try:
        window = opened.get(timeout=OPENING)
    except queue.Empty:
        window = f"nothing after {OPENING:g} s"
    if isinstance(window, Exception | str):
        raise InputError(f"Viewer: the window does not open ({window}); see what the terminal says, or {INSTEAD}")
    return window
