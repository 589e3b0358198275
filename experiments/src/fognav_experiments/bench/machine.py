"""What a figure was measured on and with."""

from __future__ import annotations

import os
import platform
from importlib.metadata import version
from pathlib import Path


def describe() -> dict[str, object]:
    """Return the machine and the versions that a benchmark's figures depend on."""
    return {
        "machine": {
            "processor": _processor(),
            "architecture": platform.machine(),
            "cores": os.cpu_count(),
            "governor": _governor(),
            "load": round(os.getloadavg()[0], 1),
            "system": platform.platform(terse=True),
        },
        "versions": {"python": platform.python_version()} | {name: version(name) for name in ("numba", "numpy")},
    }


def sentence() -> str:
    """Return the machine in a few words, with its load."""
    load = os.getloadavg()[0]
    return f"{_processor()}, {os.cpu_count()} cores, {platform.platform(terse=True)}, load {load:.0f} at the end"


def _governor(cpu: Path = Path("/sys/devices/system/cpu/cpu0")) -> str:
    """Return what decides on the processor's clock; where the system does not tell it, as virtual machines do, so."""
    try:
        return (cpu / "cpufreq" / "scaling_governor").read_text("ascii").strip()
    except OSError:
        return "not told by the system"


def _processor() -> str:
    """Return the processor's name; an empty text where the system does not tell it."""
    try:
        with open("/proc/cpuinfo", encoding="utf-8") as file:  # noqa: PTH123  # a device of the kernel
            lines = [line for line in file if line.startswith("model name")]
    except OSError:
        return platform.processor()
    return lines[0].partition(":")[2].strip() if lines else platform.processor()
