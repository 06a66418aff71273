"""`tdf env`: what a bug report needs to know about the place where the library runs."""

import json as json_text
import os
import platform
import re
from importlib import metadata
from pathlib import Path

import jax

import tdf_jax
from tdf_jax._internal.compiled import FOLDER, user_cache
from tdf_jax._internal.devices import platform_problem
from tdf_jax._internal.errors import InputError
from tdf_jax.networks.checkpoint import available_models, load_model
from tdf_jax.networks.model import fingerprint

SCHEMA = 1  # raised when a key of the JSON changes its name or its meaning
# Environment variables whose names begin so change what JAX does, or where.
PREFIXES = ("JAX_", "XLA_", "CUDA_VISIBLE_", "MUJOCO_GL", "TDF_")
DEVELOPMENT = {"bench", "check", "dev", "docs", "test"}  # extras that results do not depend on
SHORT = 16  # digits of a fingerprint in the table


def env(json: bool = False) -> None:
    """Print the versions, the devices and the fingerprints of the shipped weights, for a bug report.

    Args:
        json: print JSON instead of the table.
    """
    record = surroundings()
    print(json_text.dumps(record, indent=1) if json else _table(record))


def surroundings() -> dict:
    """The place where the library runs, as JSON values.

    Returns:
        Versions of the library, of Python and of its requirements by extra (None if one is not installed); the system;
        the devices of JAX, or why there is none; the environment variables that JAX reads; the folder of compiled
        programs; and the SHA-256 of the weights, sizes and training density of each shipped network, or why its file
        cannot be read.
    """
    problem = platform_problem()
    return {
        "schema": SCHEMA,
        "tdf_jax": tdf_jax.__version__,
        "installed": str(Path(tdf_jax.__file__).parent),
        "python": platform.python_version(),
        "system": platform.platform(),
        "cores": os.cpu_count(),
        "requirements": _requirements(),
        "devices": problem or [f"{one.platform}: {one.device_kind}" for one in jax.devices()],
        "environment": {name: value for name, value in sorted(os.environ.items()) if name.startswith(PREFIXES)},
        "compiled": os.environ.get(FOLDER) or str(user_cache("compiled")),
        "weights": {name: problem or _fingerprint(name) for name in available_models()},
    }


def _fingerprint(name: str) -> str:
    try:
        return fingerprint(load_model(name))
    except InputError as error:  # a damaged file is what a report should say
        return str(error)


def _requirements() -> dict[str, dict[str, str | None]]:
    """Installed versions of what the library requires, by extra; those of every installation are under "core"."""
    found: dict[str, dict[str, str | None]] = {}
    try:
        required = metadata.requires("tdf_jax") or []
    except metadata.PackageNotFoundError:  # imported from a checkout that is not installed
        required = ["jax", "numpy"]
    for line in ["jaxlib", *required]:
        name = re.split(r"[^\w.-]", line, maxsplit=1)[0]
        extra = re.search(r"extra == ['\"]([\w-]+)['\"]", line)
        group = extra[1] if extra else "core"
        if group not in DEVELOPMENT and name != "tdf_jax":  # an extra of an extra
            found.setdefault(group, {})[name] = _version(name)
    return found


def _version(name: str) -> str | None:
    try:
        return metadata.version(name)
    except metadata.PackageNotFoundError:
        return None


def _table(record: dict) -> str:
    lines = [
        ("tdf_jax", f"{record['tdf_jax']}, {record['installed']}"),
        ("python", record["python"]),
        ("system", f"{record['system']}, {record['cores']} cores"),
    ]
    devices = record["devices"]
    lines.append(("devices", devices if isinstance(devices, str) else "; ".join(devices)))
    for extra, versions in record["requirements"].items():
        installed = ", ".join(f"{name} {version}" for name, version in versions.items() if version)
        missing = ", ".join(name for name, version in versions.items() if not version)
        lines.append((extra, "; ".join(part for part in (installed, missing and f"not installed: {missing}") if part)))
    lines += record["environment"].items()
    lines.append(("compiled programs", record["compiled"]))
    for name, value in record["weights"].items():
        lines.append((f"weights {name}", value[:SHORT] if re.fullmatch(r"[0-9a-f]{64}", value) else value))
    width = max(len(name) for name, _ in lines) + 2
    return "\n".join(f"{name:{width}}{value}" for name, value in lines)
