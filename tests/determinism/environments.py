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

REPOSITORY = Path(__file__).resolve().parents[2]
HASWELL = "+sse4.2,+popcnt,+avx,+avx2,+fma,+f16c,+bmi,+bmi2,+lzcnt,+movbe"
_TIMEOUT = 600.0


@dataclass(frozen=True)
class Environment:
    """One setting: environment variables and arguments of the process."""

    variables: Mapping[str, str] = field(default_factory=dict)
    arguments: tuple[str, ...] = ()

    def record(self, directory):
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


def _x86():
    return platform.machine().lower() in ("x86_64", "amd64")


def _host_has(*features):
    has = llvm.get_host_cpu_features()
    return all(has.get(feature, False) for feature in features)


def _dispatched_by_numpy():
    """The CPU features that numpy has code for beyond its baseline, and this host has."""
    try:
        from numpy._core import _multiarray_umath as umath
    except ImportError:
        from numpy.core import _multiarray_umath as umath  # numpy 1
    return " ".join(name for name in umath.__cpu_dispatch__ if umath.__cpu_features__.get(name))


def _openblas():
    names = np.show_config(mode="dicts")["Build Dependencies"]["blas"]["name"]
    return "openblas" in names


def _plain_libraries():
    """Variables that take the vector units from all libraries, as far as they are here."""
    plain = {"ATEN_CPU_CAPABILITY": "default"}  # of torch
    if _x86():
        plain["MKL_CBWR"] = "COMPATIBLE"
    if _x86() and platform.libc_ver()[0] == "glibc":
        plain["GLIBC_TUNABLES"] = "glibc.cpu.hwcaps=-AVX512F,-AVX2,-FMA,-AVX2_Usable,-FMA_Usable"
    if _x86() and _openblas():
        plain["OPENBLAS_CORETYPE"] = "Prescott"
    if dispatched := _dispatched_by_numpy():
        plain["NPY_DISABLE_CPU_FEATURES"] = dispatched
    return plain


_FMA = _x86() and _host_has("avx2", "fma")
_HASWELL_BLAS = {"OPENBLAS_CORETYPE": "Haswell"} if _openblas() else {}
_GENERIC = {"NUMBA_CPU_NAME": "generic", "NUMBA_CPU_FEATURES": ""}
_HASWELL = {"NUMBA_CPU_NAME": "haswell", "NUMBA_CPU_FEATURES": HASWELL}


# Each CPU's machine code is kept apart in the kernels' cache. Several changes in one setting save
# processes: a difference shows for any of them.
ENVIRONMENTS = {
    "default": Environment(),
    "generic CPU, libraries without SIMD": Environment(_GENERIC | _plain_libraries()),
    "Haswell with FMA, two threads": Environment(
        _HASWELL | _HASWELL_BLAS if _FMA else {}, ("--threads", "2")
    ),
    "logged and scribbled over": Environment(arguments=("--watch", "scribbler")),
    "after other problems, nobody watching": Environment(
        arguments=("--again", "--watch", "nobody")
    ),
}
