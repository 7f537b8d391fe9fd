"""What a time depends on: the machine, how busy it is, and the versions of what runs."""

from __future__ import annotations

import os
import sys
from pathlib import Path
from typing import Any

import torch

from chsel.cost.torch_cost import gpus
from replay.environment import environment
from replay.startup import package_version

_PACKAGES = ("numba", "llvmlite", "scipy")


def machine() -> dict[str, Any]:
    """Processor, cores, GPU, Python and versions."""
    values: dict[str, Any] = {**environment(), "cores": os.cpu_count(), "cores_usable": cores()}
    values["gpu"] = torch.cuda.get_device_name() if gpus() else None
    return values | {f"package {name}": package_version(name) for name in _PACKAGES}


def cores() -> int:
    """Cores that this process may use."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def load() -> float | None:
    """Processes that ran or waited in the mean over the last minute, where the system tells."""
    return round(os.getloadavg()[0], 2) if hasattr(os, "getloadavg") else None


def peak_memory() -> int:
    """Peak memory of this process in bytes."""
    # Not getrusage where there is another way: a new process inherits its parent's peak there.
    try:
        status = Path("/proc/self/status").read_text()
        return 1024 * int(status.split("VmHWM:")[1].split()[0])
    except (OSError, IndexError):
        import resource

        peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
        return peak if sys.platform == "darwin" else 1024 * peak
