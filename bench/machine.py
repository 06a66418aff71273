"""The machine of a measurement: processor, versions, load, and the memory of a process."""

import contextlib
import ctypes
import importlib.metadata
import os
import platform
from pathlib import Path

PACKAGES = ("jax", "jaxlib", "torch", "numpy", "tdf_jax")


def machine() -> dict:
    """Processor, cores, memory in GB, load over the last minute, and versions."""
    return {
        "cpu": _processor(),
        "cores": cores(),
        "memory_gigabytes": round(_field("/proc/meminfo", "MemTotal") / 1e9, 1),
        "load": round(os.getloadavg()[0], 2),
        "system": f"{platform.system()} {platform.machine()}",
        "python": platform.python_version(),
        **{name: _version(name) for name in PACKAGES},
    }


def cores() -> int:
    """Processors that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count()


def available() -> float:
    """Available memory without swapping, bytes; infinite if the system does not report it."""
    return _field("/proc/meminfo", "MemAvailable") or float("inf")


def resident() -> float:
    """Resident memory of this process, bytes."""
    return _field("/proc/self/status", "VmRSS")


def peak() -> float:
    """Peak of the resident memory since `settle`, bytes; since the start if the system cannot reset it."""
    return _field("/proc/self/status", "VmHWM")


def settle() -> None:
    """Return freed memory to the system and begin a new peak.

    The tuned PyTorch keeps all memory that it ever had, so it would otherwise show the peak of an earlier row.
    """
    with contextlib.suppress(OSError, AttributeError):
        ctypes.CDLL(None).malloc_trim(0)
    with contextlib.suppress(OSError):
        Path("/proc/self/clear_refs").write_text("5")


def busy() -> float:
    """Busy seconds of all processors together since the system started."""
    with contextlib.suppress(OSError):
        user, nice, system, _, _, interrupts, soft = map(int, Path("/proc/stat").read_text().split()[1:8])
        return (user + nice + system + interrupts + soft) / os.sysconf("SC_CLK_TCK")
    return 0.0


def _field(path, name):
    """A number of kB of a /proc file, in bytes; 0 where there is none."""
    with contextlib.suppress(OSError):
        for line in Path(path).read_text().splitlines():
            if line.startswith(f"{name}:"):
                return 1024.0 * int(line.split()[1])
    return 0.0


def _processor():
    with contextlib.suppress(OSError):
        for line in Path("/proc/cpuinfo").read_text().splitlines():
            if line.startswith("model name"):
                return line.partition(":")[2].strip()
    return platform.processor() or platform.machine()


def _version(name):
    with contextlib.suppress(importlib.metadata.PackageNotFoundError):
        return importlib.metadata.version(name)
    return None
