"""The process that `fresh` measures: it imports no more than a program of a user does.

`python -m runners.benchmarks.fresh_process JSON` imports the library, registers once if JSON names
a problem and a method, and prints its peak memory. It imports torch first if JSON says so.
"""

from __future__ import annotations

import base64
import json
import pickle
import sys
from pathlib import Path
from typing import Any

from chsel import register  # noqa: F401  # what a user imports
from runners.published_package.problem_file import load_problem


def main(task: dict[str, Any]) -> None:
    """Do the task of one such process."""
    if task.get("torch"):
        import torch  # noqa: F401
    if task:
        method: Any = pickle.loads(base64.b64decode(task["method"]))
        method.register(load_problem(Path(task["problem"])))
    sys.stdout.write(json.dumps({"bytes": peak_memory()}) + "\n")


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


if __name__ == "__main__":
    main(json.loads(sys.argv[1]))
