"""The settings under which every bit must stay: threads, CPUs, libraries, who watches."""

from __future__ import annotations

import os
import platform
import subprocess
import sys
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

import llvmlite.binding as llvm
import numpy as np

from tests.determinism.record import read_record
from tests.determinism.stages import Stages

REPOSITORY = Path(__file__).resolve().parents[2]
HASWELL = "+sse4.2,+popcnt,+avx,+avx2,+fma,+f16c,+bmi,+bmi2,+lzcnt,+movbe"
_TIMEOUT = 600.0


@dataclass(frozen=True)
class Environment:
    """One setting: environment variables and arguments of the process, or why it cannot be had."""

    variables: Mapping[str, str] = field(default_factory=dict)
    arguments: tuple[str, ...] = ()
    impossible: str | None = None

    def record(self, directory: Path) -> tuple[dict[str, Stages], dict[str, str]]:
        """Run all cases in a fresh process; see read_record for what comes back."""
        directory.mkdir(parents=True, exist_ok=True)
        path = directory / "record.npz"
        environment = {**os.environ, "OMP_NUM_THREADS": "1", **self.variables}
        command = [sys.executable, "-m", "tests.determinism.record", str(path), *self.arguments]
        done = subprocess.run(
            command,
            cwd=REPOSITORY,
            env=environment,
            capture_output=True,
            text=True,
            timeout=_TIMEOUT,
        )
        if done.returncode != 0:
            raise RuntimeError(f"{' '.join(command)} failed:\n{done.stderr[-3000:]}")
        return read_record(path)


def _x86() -> bool:
    return platform.machine().lower() in ("x86_64", "amd64")


def _host_has(*features: str) -> bool:
    has = llvm.get_host_cpu_features()
    return all(has.get(feature, False) for feature in features)


def _dispatched_by_numpy() -> str:
    """The CPU features that numpy has code for beyond its baseline, and this host has."""
    try:
        from numpy._core import _multiarray_umath as umath
    except ImportError:
        from numpy.core import _multiarray_umath as umath  # type: ignore[no-redef]  # numpy 1
    return " ".join(name for name in umath.__cpu_dispatch__ if umath.__cpu_features__.get(name))


def _openblas() -> bool:
    names = np.show_config(mode="dicts")["Build Dependencies"]["blas"]["name"]  # type: ignore[index]
    return "openblas" in names


_NOT_X86 = None if _x86() else f"this is a {platform.machine()}, not an x86-64"
_NO_FMA = None if _x86() and _host_has("avx2", "fma") else "this CPU lacks AVX2 or FMA"
_NO_GLIBC = None if _x86() and platform.libc_ver()[0] == "glibc" else "no glibc on x86-64 here"
_NO_OPENBLAS = None if _openblas() else "numpy has another BLAS here"
_PLAIN_LIBM = "glibc.cpu.hwcaps=-AVX512F,-AVX2,-FMA,-AVX2_Usable,-FMA_Usable"
_NUMPY = _dispatched_by_numpy()

# Each CPU's machine code is kept apart in the kernels' cache.
ENVIRONMENTS = {
    "default": Environment(),
    "generic CPU": Environment({"NUMBA_CPU_NAME": "generic", "NUMBA_CPU_FEATURES": ""}),
    "two threads": Environment(arguments=("--threads", "2")),
    "Haswell with FMA": Environment(
        {"NUMBA_CPU_NAME": "haswell", "NUMBA_CPU_FEATURES": HASWELL}, impossible=_NO_FMA
    ),
    "C library without FMA": Environment({"GLIBC_TUNABLES": _PLAIN_LIBM}, impossible=_NO_GLIBC),
    "OpenBLAS for Prescott": Environment(
        {"OPENBLAS_CORETYPE": "Prescott"}, impossible=_NOT_X86 or _NO_OPENBLAS
    ),
    "OpenBLAS for Haswell": Environment(
        {"OPENBLAS_CORETYPE": "Haswell"}, impossible=_NO_FMA or _NO_OPENBLAS
    ),
    "torch without SIMD": Environment({"ATEN_CPU_CAPABILITY": "default"}),
    "MKL for any CPU": Environment({"MKL_CBWR": "COMPATIBLE"}, impossible=_NOT_X86),
    "numpy without SIMD": Environment(
        {"NPY_DISABLE_CPU_FEATURES": _NUMPY},
        impossible=None if _NUMPY else "numpy has no code beyond its baseline for this CPU",
    ),
    "nobody watching": Environment(arguments=("--watch", "nobody")),
    "logged and scribbled over": Environment(arguments=("--watch", "scribbler")),
    "after other problems": Environment(arguments=("--again",)),
}
