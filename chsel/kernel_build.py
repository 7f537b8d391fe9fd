"""Compiles all kernels for common processors, so that an installation brings their machine code.

`python -m chsel.kernel_build` puts it into the package that it runs from, for this version of
Python and numba. It takes minutes. A wheel that is built then has it, and is for this platform.
"""

from __future__ import annotations

import argparse
import os
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

from chsel.numerics.kernel_cache import CACHE_VARIABLE
from chsel.numerics.packaged_code import TARGETS, target_folder, usable_targets, write_list

_REHEARSE = "from chsel.kernel_build import rehearse_all; rehearse_all()"


def rehearse_all() -> None:
    """Run every kernel that methods, policies, sensing and the plausible set need."""
    from chsel.methods import build_method, preset_settings
    from chsel.methods.registry import OURS as METHODS
    from chsel.policies import build_policy
    from chsel.policies.policy_registry import OURS as POLICIES
    from chsel.problem.settings import PRESETS
    from chsel.rehearsal import warm_up, warm_up_plausible, warm_up_policy, warm_up_sensing

    for method in METHODS:
        for preset in PRESETS:
            warm_up(build_method(method, preset_settings(method, preset)))
    for policy in POLICIES:
        warm_up_policy(build_policy(policy))
    warm_up_sensing()
    warm_up_plausible()


def build(target: str) -> int:
    """Compile all kernels for one of the usable targets into its folder; returns how many."""
    folder = target_folder(target)
    folder.parent.mkdir(exist_ok=True)
    with tempfile.TemporaryDirectory(dir=folder.parent) as scratch:
        environment = {**os.environ, CACHE_VARIABLE: scratch, "NUMBA_CPU_NAME": target}
        environment |= {"NUMBA_CPU_FEATURES": "", "OMP_NUM_THREADS": "1"}
        command = [sys.executable, "-c", _REHEARSE]
        subprocess.run(command, env=environment, check=True, stderr=subprocess.DEVNULL)
        return collect(Path(scratch), folder)


def collect(kept: Path, folder: Path) -> int:
    """Take files of code below a folder of a cache into one of the package; returns how many."""
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True)
    files = [Path(shutil.copyfile(file, folder / file.name)) for file in kept.rglob("*.nbc")]
    write_list(folder, files)
    return len(files)


def main(arguments: Sequence[str] | None = None) -> None:
    """The command."""
    parser = argparse.ArgumentParser("python -m chsel.kernel_build", description=__doc__)
    shown = ", ".join(TARGETS)
    parser.add_argument("targets", nargs="*", help=f"all that this CPU can run, or some of {shown}")
    usable = usable_targets()
    targets = parser.parse_args(arguments).targets or usable
    for target in targets:
        if target not in usable:
            parser.error(f"target {target} cannot run on this CPU; accepted: {', '.join(usable)}")
    with ThreadPoolExecutor(os.cpu_count()) as pool:
        for target, count in zip(targets, pool.map(build, targets), strict=True):
            print(f"{count} kernels for {target} in {target_folder(target)}")


if __name__ == "__main__":
    main()
