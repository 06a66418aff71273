"""The browser in which pages and the viewer are measured and tested: Chromium, which draws on the processor."""

import shutil
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from tdf_jax._internal.errors import InputError

BROWSERS = ("chromium", "chromium-browser", "google-chrome")
SOFTWARE = ("--no-sandbox", "--use-angle=swiftshader", "--enable-unsafe-swiftshader", "--ignore-gpu-blocklist")


def browser_program(function: str) -> str:
    """Program of the first browser that is installed.

    Args:
        function: name that the error message begins with.

    Raises:
        InputError: there is none.
    """
    found = next(filter(None, map(shutil.which, BROWSERS)), None)
    if found is None:
        raise InputError(
            f"{function}: no browser is installed; expected one of {', '.join(BROWSERS)}; "
            "on Debian: apt install chromium"
        )
    return found


def on_screen(server: Any, xyz: np.ndarray) -> np.ndarray:
    """Where a point of the world is in the one browser that is connected to a viewer, pixels.

    Args:
        server: the `viser.ViserServer`.
        xyz: the point, (3,), metres.
    """
    (client,) = server.get_clients().values()
    camera = client.camera
    x, y, z = Rotation.from_quat(camera.wxyz, scalar_first=True).inv().apply(np.asarray(xyz) - camera.position)
    scale = camera.image_height / 2 / np.tan(camera.fov / 2)
    return np.array([camera.image_width / 2 + scale * x / z, camera.image_height / 2 + scale * y / z])
