"""Pictures and films of a cell, rendered off screen."""

import copy
import importlib
import os
import platform
from typing import Any

import numpy as np
from jaxtyping import UInt8
from numpy.typing import ArrayLike

from tdf_jax._internal import checks
from tdf_jax._internal.errors import InputError
from tdf_jax.sim.physics import extra
from tdf_jax.sim.robot import PREFIX
from tdf_jax.sim.workcell import TABLE_NAME

WIDTH, HEIGHT = 640, 480  # pixels
RATE = 20.0  # pictures in a second of simulated time
CENTRE, DISTANCE = (0.38, 0.0, 0.40), 2.35  # metres: the arm, the table and what is carried over it are in the picture
AZIMUTH, ELEVATION, FOVY = 145.0, -27.0, 40.0  # degrees; the ground fills what is behind
# What is drawn around the cell, and its light. The first light casts the shadows; the other fills them.
GROUND = -0.72  # metres, height of the floor under the table
GROUND_COLOUR, WOOD, STEEL = (0.80, 0.83, 0.86, 1.0), (0.62, 0.58, 0.53, 1.0), (0.35, 0.37, 0.40, 1.0)
LIGHTS = (((-0.25, 0.35, -1.0), 0.45, True), ((0.8, 0.4, -0.7), 0.22, False))
AMBIENT, HEADLIGHT = 0.42, 0.14
SAMPLES, SHADOW = 4, 2048  # of a pixel, and texels of a shadow's map
CONTEXTS = {"egl": "mujoco.egl", "osmesa": "mujoco.osmesa", "glfw": "mujoco.glfw", "cgl": "mujoco.cgl"}


class Recorder:
    """Takes pictures of a cell while it runs, and saves them as a film.

    The model and the state stay as they are: light, ground and camera belong to the recorder. Use it as a context
    manager, or close it.

    Attributes:
        frames: the pictures so far, (height, width, 3) each.
        rate: pictures in a second of simulated time, which the film plays in a second.
    """

    def __init__(
        self,
        model: Any,
        *,
        width: int = WIDTH,
        height: int = HEIGHT,
        rate: float = RATE,
        centre: ArrayLike = CENTRE,
        distance: float = DISTANCE,
        azimuth: float = AZIMUTH,
        elevation: float = ELEVATION,
        fovy: float = FOVY,
    ):
        """Prepare the renderer.

        Args:
            model: the `mujoco.MjModel` of the cell.
            width: width of a picture, pixels.
            height: height of a picture, pixels.
            rate: pictures in a second of simulated time, at most 50 (a GIF plays no more).
            centre: point in the middle of the picture, (3,), metres, world frame.
            distance: distance of the camera from it, metres.
            azimuth: direction in which the camera looks, degrees about z from x.
            elevation: angle of that direction above the horizontal, degrees; negative looks down.
            fovy: vertical field of view, degrees.

        Raises:
            InputError: a value is out of range, or nothing renders off screen here.
        """
        mujoco = extra("Recorder", "mujoco")
        for name, value in (("width", width), ("height", height)):
            checks.count("Recorder", name, value)
            if value % 2:
                raise InputError(f"Recorder: {name} is {value}; expected an even number, which films need")
        checks.number("Recorder", "rate", checks.positive("Recorder", "rate", rate), most=50.0)
        middle = np.asarray(checks.vector("Recorder", "centre", centre))
        checks.positive("Recorder", "distance", distance, "metres")
        checks.number("Recorder", "azimuth", azimuth, unit="degrees")
        checks.number("Recorder", "elevation", elevation, -90.0, 90.0, "degrees")
        checks.number("Recorder", "fovy", fovy, 1.0, below=180.0, unit="degrees")
        self.frames: list[UInt8[np.ndarray, "height width 3"]] = []
        self.rate = float(rate)
        self._mujoco, self._next = mujoco, 0.0
        self._context = self._renderer = None
        self._model = copy.copy(model)
        look = self._model.vis
        look.global_.offwidth, look.global_.offheight, look.global_.fovy = width, height, fovy
        look.quality.offsamples, look.quality.shadowsize = SAMPLES, SHADOW
        look.headlight.ambient, look.headlight.diffuse, look.headlight.specular = AMBIENT, HEADLIGHT, 0.05
        self._model.light_active[:] = 0
        self._camera = mujoco.MjvCamera()
        self._camera.type = mujoco.mjtCamera.mjCAMERA_FREE
        self._camera.lookat, self._camera.distance = middle, distance
        self._camera.azimuth, self._camera.elevation = azimuth, elevation
        self._options = mujoco.MjvOption()
        self._scene = mujoco.MjvScene(self._model, maxgeom=self._model.ngeom + 1000)
        self._area = mujoco.MjrRect(0, 0, width, height)
        self._context = gl_context(width, height)
        self._context.make_current()
        self._renderer = mujoco.MjrContext(self._model, mujoco.mjtFontScale.mjFONTSCALE_150)
        mujoco.mjr_setBuffer(mujoco.mjtFramebuffer.mjFB_OFFSCREEN, self._renderer)

    def __enter__(self):
        return self

    def __exit__(self, *about):
        self.close()

    def close(self) -> None:
        """Free the renderer; the pictures stay."""
        if self._context is not None:
            self._context.make_current()
            if self._renderer is not None:
                self._renderer.free()
            self._context.free()
        self._context = self._renderer = None

    def picture(self, data: Any) -> UInt8[np.ndarray, "height width 3"]:
        """A picture of a state, (height, width, 3), red, green and blue from 0 to 255.

        Args:
            data: the state.

        Raises:
            InputError: the recorder is closed.
        """
        if self._context is None:
            raise InputError("Recorder.picture(): the recorder is closed; make a new one")
        mujoco, scene = self._mujoco, self._scene
        mujoco.mjv_updateScene(self._model, data, self._options, None, self._camera, mujoco.mjtCatBit.mjCAT_ALL, scene)
        self._furnish()
        self._light()
        self._context.make_current()
        mujoco.mjr_render(self._area, scene, self._renderer)
        pixels = np.empty((self._area.height, self._area.width, 3), np.uint8)
        mujoco.mjr_readPixels(pixels, None, self._area, self._renderer)
        return pixels[::-1].copy()

    def take(self, data: Any) -> None:
        """Add a picture of a state to the film, whatever its time."""
        self.frames.append(self.picture(data))

    def watch(self, data: Any, step: int = 0, phase: str = "") -> None:
        """Add a picture if it is time for one; call it after every step, as `execute(..., watch=)` does.

        Args:
            data: the state, whose time counts.
            step: not used.
            phase: not used.
        """
        if data.time >= self._next - 1e-9:
            self.take(data)
            self._next = max(self._next, data.time - 1e-9) + 1 / self.rate

    def save(self, path: str | os.PathLike) -> None:
        """Save the film.

        Args:
            path: file to write, in an existing folder: `.gif`, or `.mp4` with the extra "films".

        Raises:
            InputError: there are no pictures, the ending is another one, imageio-ffmpeg is missing, or the file cannot
                be written.
        """
        from tdf_jax.viz.film_file import save_film

        save_film(path, self.frames, self.rate)

    def _furnish(self) -> None:
        """The ground, legs of the table and a pedestal of the robot."""
        mujoco, model = self._mujoco, self._model
        self._draw(mujoco.mjtGeom.mjGEOM_BOX, (30, 30, 0.01), (0, 0, GROUND - 0.01), GROUND_COLOUR)
        box = mujoco.mjtGeom.mjGEOM_BOX
        table = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_GEOM, TABLE_NAME)
        if table >= 0 and model.geom_type[table] == box:
            centre, half = model.geom_pos[table], model.geom_size[table]
            length = (centre[2] - half[2] - GROUND) / 2
            for x in (-1, 1):
                for y in (-1, 1):
                    place = (*(centre[:2] + (half[:2] - 0.03) * (x, y)), GROUND + length)
                    self._draw(box, (0.025, 0.025, length), place, WOOD)
        for body in range(1, model.nbody):
            if model.body_parentid[body] == 0 and model.body(body).name.startswith(PREFIX):
                if model.body_jntnum[body] == 0:
                    place = model.body_pos[body]
                    length = (place[2] - GROUND) / 2
                    self._draw(box, (0.09, 0.09, length), (*place[:2], GROUND + length), STEEL)

    def _draw(self, kind, size, place, colour) -> None:
        scene = self._scene
        if scene.ngeom < scene.maxgeom:
            geom = scene.geoms[scene.ngeom]
            self._mujoco.mjv_initGeom(
                geom,
                kind,
                np.array(size, float),
                np.array(place, float),
                np.eye(3).ravel(),
                np.array(colour, np.float32),
            )
            geom.category = self._mujoco.mjtCatBit.mjCAT_STATIC  # what is decoration casts no shadow
            geom.specular, geom.shininess, geom.reflectance = 0.1, 0.2, 0.0
            scene.ngeom += 1

    def _light(self) -> None:
        scene = self._scene
        for direction, strength, shadow in LIGHTS:
            light = scene.lights[scene.nlight]
            light.type = self._mujoco.mjtLightType.mjLIGHT_DIRECTIONAL
            light.headlight, light.castshadow = 0, int(shadow)
            light.dir = np.array(direction) / np.linalg.norm(direction)
            light.pos = self._camera.lookat - 3 * light.dir
            light.attenuation, light.cutoff, light.exponent = (1, 0, 0), 45, 10
            light.ambient, light.diffuse, light.specular = np.zeros(3), np.full(3, strength), np.full(3, 0.2 * strength)
            light.texid, light.id = -1, -1
            scene.nlight += 1


def check_film(path: str | os.PathLike) -> None:
    """Raise InputError unless films can be rendered here, and saved under a name; nothing is written.

    Call it before the run whose film is wanted: a picture of an empty world is rendered.

    Args:
        path: file that is to be written, `.gif` or `.mp4`.

    Raises:
        InputError: nothing renders off screen here, or see `Recorder.save`.
    """
    from tdf_jax.viz.film_file import check_encoder

    check_encoder(path)
    mujoco = extra("Recorder", "mujoco")
    model = mujoco.MjModel.from_xml_string("<mujoco/>")
    with Recorder(model) as recorder:
        recorder.picture(mujoco.MjData(model))


def gl_context(width: int, height: int) -> Any:
    """A context of OpenGL that renders off screen: the one that `MUJOCO_GL` names, or the first that works.

    It does not matter whether `MUJOCO_GL` was set before mujoco was imported.

    Args:
        width: width of pictures, pixels.
        height: height of pictures, pixels.

    Raises:
        InputError: none works.
    """
    wanted = os.environ.get("MUJOCO_GL", "").lower().strip()
    if wanted in CONTEXTS:
        names = [wanted]
    else:
        names = {"Linux": ["egl", "glfw"], "Darwin": ["cgl", "glfw"]}.get(platform.system(), ["glfw"])
    reasons = []
    for name in names if wanted not in ("disable", "disabled", "off", "false", "0") else ():
        if name == "glfw" and platform.system() == "Linux" and not _has_screen():
            reasons.append("glfw: there is no screen")
            continue
        try:
            context = importlib.import_module(CONTEXTS[name]).GLContext(width, height)
            context.make_current()
            return context
        except Exception as error:  # every driver fails in its own way
            reasons.append(f"{name}: {error}")
    raise InputError(
        f"Recorder: nothing renders off screen here ({'; '.join(reasons) or 'MUJOCO_GL is ' + wanted}). On Linux "
        "install EGL (apt install libegl1 libgl1-mesa-dri) and set MUJOCO_GL=egl or leave it unset. Only pictures and "
        "films need it; episodes and their clouds do not"
    )


def _has_screen() -> bool:
    return bool(os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY"))
