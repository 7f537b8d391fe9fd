"""All cases in one process, `python -m tests.determinism.record OUT.json`, and where it may run."""

import argparse
import json
import os
import platform
import subprocess
import sys
import warnings
from pathlib import Path

import llvmlite.binding as llvm
import numba
import numpy as np
import torch

from chsel.numerics.arrays import digest
from tests.chsel.samples import REPOSITORY
from tests.determinism.cases import CASES
from tests.determinism.decisions import SCENES, decision_stages
from tests.determinism.stages import Scribbler, StageKeeper, grid, nobody, run

WATCHES = {"stages": StageKeeper, "nobody": nobody, "scribbler": Scribbler}
Golden = dict[str, dict[str, list[str]]]
"""By case and stage: a digest of all arrays, then a few of their numbers in hexadecimal."""


def condensed(stages):
    """Digests, short enough to be read, and samples of the stages of a case."""
    return {
        stage: [digest(*arrays.values())[:16], *_samples(arrays)]
        for stage, arrays in stages.items()
    }


def _samples(arrays, count=3):
    parts = [array.reshape(-1) for array in arrays.values() if array.dtype == np.float64]
    numbers = np.concatenate(parts)
    return [float(numbers[(i * len(numbers)) // count]).hex() for i in range(count)]


@numba.njit(fastmath={"contract"})
def fused(x):
    """x^2 - x (N,), rounded once on a CPU that can multiply and add in one: never done so."""
    out = np.empty_like(x)
    for i in range(len(x)):
        out[i] = x[i] * x[i] - x[i]
    return out


def recorded(environment, path):
    """What a fresh process gives: the record, and the digest of a kernel that fuses if it can."""
    variables, arguments = environment
    command = [sys.executable, "-m", "tests.determinism.record", str(path), *arguments]
    given = {**os.environ, "OMP_NUM_THREADS": "1", **variables}
    done = subprocess.run(command, cwd=REPOSITORY, env=given, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr[-3000:]
    return json.loads(path.read_text())


IS_X86 = platform.machine().lower() in ("x86_64", "amd64")


def _plain_libraries():
    """Variables that take the vector units from all libraries, as far as they are here."""
    try:
        from numpy._core import _multiarray_umath as umath
    except ImportError:
        from numpy.core import _multiarray_umath as umath  # numpy 1
    names = [name for name in umath.__cpu_dispatch__ if umath.__cpu_features__.get(name)]
    plain = {"ATEN_CPU_CAPABILITY": "default"}  # of torch
    plain |= {"NPY_DISABLE_CPU_FEATURES": " ".join(names)} if names else {}
    if IS_X86:
        plain |= {"MKL_CBWR": "COMPATIBLE", "OPENBLAS_CORETYPE": "Prescott"}
        tunables = "glibc.cpu.hwcaps=-AVX512F,-AVX2,-FMA,-AVX2_Usable,-FMA_Usable"
        plain |= {"GLIBC_TUNABLES": tunables} if platform.libc_ver()[0] == "glibc" else {}
    return plain


_features = llvm.get_host_cpu_features()
HAS_FMA = IS_X86 and _features.get("avx2", False) and _features.get("fma", False)
_GENERIC = {"NUMBA_CPU_NAME": "generic", "NUMBA_CPU_FEATURES": ""}
_HASWELL = {
    "NUMBA_CPU_NAME": "haswell",
    "NUMBA_CPU_FEATURES": "+sse4.2,+popcnt,+avx,+avx2,+fma,+f16c,+bmi,+bmi2,+lzcnt,+movbe",
    "OPENBLAS_CORETYPE": "Haswell",
}
# Variables and arguments of the process. Each CPU's machine code is kept apart in the kernels'
# cache. Several changes in one setting save processes: a difference shows for any of them.
ENVIRONMENTS = {
    "default": ({}, ()),
    "generic CPU, libraries without SIMD": (_GENERIC | _plain_libraries(), ()),
    "Haswell with FMA, two threads": (_HASWELL if HAS_FMA else {}, ("--threads", "2")),
    "after other problems, scribbled over": ({}, ("--again", "--watch", "scribbler")),
    "nobody watching": ({}, ("--watch", "nobody")),
}


def main():
    """Run the cases as the command line says."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("out", type=Path)
    parser.add_argument("--threads", type=int, default=1)
    parser.add_argument("--watch", choices=WATCHES, default="stages")
    parser.add_argument("--again", action="store_true", help="after all cases in other order")
    arguments = parser.parse_args()
    torch.set_num_threads(arguments.threads)
    warnings.filterwarnings("ignore", category=UserWarning, module="chsel")
    kept = {body: grid(body) for body in {case.body for case in CASES.values()}}
    if arguments.again:
        for case in reversed(CASES.values()):
            run(case, kept[case.body], watch=nobody)
        for place in reversed(SCENES):
            decision_stages(place, kept[place])
    record = {}
    for name, case in CASES.items():
        sdf = kept[case.body] if arguments.again else grid(case.body)
        record[name] = condensed(run(case, sdf, watch=WATCHES[arguments.watch]))
    for place in SCENES:
        stages = decision_stages(place, kept[place] if arguments.again else grid(place))
        record |= {case: condensed(each) for case, each in stages.items()}
    x = np.random.Generator(np.random.Philox(5)).random(9216) + 0.1
    arguments.out.write_text(json.dumps([record, digest(fused(x))]))


if __name__ == "__main__":
    main()
