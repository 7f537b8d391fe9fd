"""The golden digests: `python -m tests.tools.golden [--write] [--all]`.

Without options: what differs from golden.json here. --write: make it anew, and say what changed.
--all: compare every setting of the matrix, and say which libraries each setting changes.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
from collections.abc import Mapping
from pathlib import Path

from tests.determinism.comparison import (
    GOLDEN_FILE,
    Golden,
    condensed,
    differences,
    other_versions,
    read_golden,
    write_golden,
)
from tests.determinism.environments import ENVIRONMENTS, Environment
from tests.determinism.stages import Stages


def main() -> None:
    """Compare or write; status 1 where something differs."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--write", action="store_true", help="write golden.json")
    parser.add_argument("--all", action="store_true", help="every setting, not the default alone")
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory() as directory:
        record, libraries = ENVIRONMENTS["default"].record(Path(directory))
        golden = read_golden() if GOLDEN_FILE.exists() else {}
        lines = _changes(golden, record)
        print("\n".join(lines) or f"all {len(record)} cases are as in {GOLDEN_FILE.name}")
        if golden and other_versions():
            print(f"{GOLDEN_FILE.name} was made with other packages: here {other_versions()}")
        if arguments.write:
            golden = condensed(record)
            write_golden(golden)
            print(f"{GOLDEN_FILE.name} written: {GOLDEN_FILE.stat().st_size} bytes")
        unequal = bool(lines) and not arguments.write
        if arguments.all:
            unequal |= _matrix(ENVIRONMENTS, golden, record, libraries, Path(directory))
    sys.exit(int(unequal))


def _changes(golden: Golden, record: dict[str, Stages]) -> list[str]:
    """What differs in the default setting, with stages that are gone."""
    lines = differences(golden, record)
    for case, stages in record.items():
        gone = [stage for stage in golden.get(case, {}) if stage not in stages]
        lines += [f"{case}: {len(gone)} stages are gone, first {gone[0]!r}"] if gone else []
    return lines


def _matrix(
    matrix: Mapping[str, Environment],
    golden: Golden,
    usual: dict[str, Stages],
    libraries: dict[str, str],
    directory: Path,
) -> bool:
    """Print a line or more for each setting; whether any differs."""
    unequal = False
    for name, environment in matrix.items():
        record, theirs = environment.record(directory)
        lines = differences(golden, record, usual)
        unequal |= bool(lines)
        changed = [library for library in libraries if theirs[library] != libraries[library]]
        verdict = f"{len(lines)} of {len(record)} cases differ" if lines else "equal"
        print(f"{name}: {verdict} (libraries changed: {', '.join(changed) or 'none'})", flush=True)
        print("".join(f"  {line}\n" for line in lines), end="")
    return unequal


if __name__ == "__main__":
    main()
