"""The environment of a result besides its inputs: versions, platform, checkout."""

from __future__ import annotations

import platform
import subprocess
from importlib.metadata import entry_points
from pathlib import Path

from chsel.events import SessionStarted
from replay.startup import package_version

PACKAGES = (
    "chsel-replay",
    "numpy",
    "numba",
    "llvmlite",
    "torch",
    "libigl",
    "trimesh",
    "pybullet",
    "mujoco-core",
    "mcap",
)


def environment() -> dict[str, str]:
    """Return names and values, equal for every run of one checkout on one machine."""
    values = {
        "python": platform.python_version(),
        "platform": f"{platform.system()} {platform.machine()}",
        "processor": _processor(),
        "checkout": _checkout(),
    }
    offering = {point.dist.name for point in entry_points(group="chsel.methods") if point.dist}
    packages = [*PACKAGES, *sorted(offering.difference(PACKAGES))]
    return values | {f"package {name}": package_version(name) for name in packages}


def environment_differences(start: SessionStarted) -> tuple[str, ...]:
    """Return the lines of the recorded environment that differ here."""
    here = environment()
    return tuple(
        f"{name} {value} -> {here.get(name, 'unknown')}"
        for name, value in start.environment.items()
        if here.get(name) != value
    )


def _processor() -> str:
    """Return the model name of the processor."""
    try:
        for line in Path("/proc/cpuinfo").read_text().splitlines():
            if line.startswith("model name"):
                return line.split(":", 1)[1].strip()
    except OSError:
        pass
    return platform.processor() or "unknown"


def _checkout() -> str:
    """Return the commit that runs, and whether files differ from it; "none" if installed."""
    folder = Path(__file__).resolve().parent
    try:
        described = subprocess.run(
            ["git", "describe", "--always", "--dirty", "--abbrev=40", "--exclude=*"],
            cwd=folder,
            capture_output=True,
            text=True,
            timeout=10,
            check=True,
        )
    except (OSError, subprocess.SubprocessError):
        return "none"
    return described.stdout.strip()
