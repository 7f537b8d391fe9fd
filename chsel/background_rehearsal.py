"""The search of CHSEL is compiled in a process of its own, beside all other kernels in this one.

`python -m chsel.background_rehearsal` is that process.
"""

from __future__ import annotations

import atexit
import os
import pickle
import subprocess
import sys
from contextlib import suppress
from typing import Any

from chsel.methods.chsel import ChselSettings
from chsel.methods.method import Method
from chsel.numerics.threads import thread_count
from chsel.rehearsal import warm_up_search


def rehearse_search_beside(method: Method) -> None:
    """Begin to compile the search of `method`, if it is CHSEL's, on another core.

    Its kernel is that which takes longest to compile. A registration in this process waits for it
    where it needs it. If this process ends before the other one, it ends that, too.
    """
    if thread_count() < 2 or not isinstance(getattr(method, "settings", None), ChselSettings):
        return
    environment = {**os.environ, "OMP_NUM_THREADS": "1", "PYTHONPATH": os.pathsep.join(sys.path)}
    task = pickle.dumps(method)
    with suppress(OSError):  # without that process, all is compiled in this one
        process: Any = subprocess.Popen(
            [sys.executable, "-m", "chsel.background_rehearsal"],
            env=environment,
            stdin=subprocess.PIPE,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
        )
        atexit.register(process.terminate)
        process.stdin.write(task)
        process.stdin.close()


def main() -> None:
    """Rehearse the search of the method on standard input."""
    method: Method = pickle.loads(sys.stdin.buffer.read())
    warm_up_search(method)


if __name__ == "__main__":
    main()
