"""Kernels are compiled in processes of their own, while this one does something else.

`python -m chsel.background_rehearsal PART` is one of them. Without a part, it compiles what
method=chsel needs, for an installation.
"""

from __future__ import annotations

import atexit
import os
import pickle
import subprocess
import sys
from collections.abc import Callable
from contextlib import suppress

from chsel.methods import build_method
from chsel.methods.method import ConfiguredMethod, Method
from chsel.numerics.threads import core_count
from chsel.rehearsal import warm_up, warm_up_longest

_PARTS: dict[str, Callable[[Method], None]] = {  # of CHSEL, they take about the same time
    "longest_stage": warm_up_longest,
    "registration": warm_up,
}


def rehearse_beside(method: Method) -> list[subprocess.Popen[bytes]]:
    """Begin to compile what registrations by `method` need, in other processes; returns these.

    Two, or one if the method names no longest stage; none on a single core. This process
    waits for each kernel where it needs it. If it ends before the others, it ends them, too.
    """
    if core_count() < 2:
        return []
    parts, none = list(_PARTS), ConfiguredMethod.longest_stage
    if getattr(type(method), "longest_stage", none) is none:
        parts = ["registration"]
    environment = {**os.environ, "OMP_NUM_THREADS": "1", "PYTHONPATH": os.pathsep.join(sys.path)}
    task, processes = pickle.dumps(method), []
    with suppress(OSError):  # without a process, this one compiles
        for part in parts:
            process = subprocess.Popen(
                [sys.executable, "-m", "chsel.background_rehearsal", part],
                env=environment,
                stdin=subprocess.PIPE,
                stdout=subprocess.DEVNULL,
                stderr=subprocess.DEVNULL,
            )
            atexit.register(process.terminate)
            processes.append(process)
            assert process.stdin is not None
            process.stdin.write(task)
            process.stdin.close()
    return processes


def main() -> None:
    """Rehearse a part of the method on standard input, or all of CHSEL."""
    if len(sys.argv) == 1:
        warm_up(build_method("chsel"))
    else:
        _PARTS[sys.argv[1]](pickle.loads(sys.stdin.buffer.read()))


if __name__ == "__main__":
    main()
