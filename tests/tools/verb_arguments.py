"""Arguments with which each verb of `replay` runs on a recording."""

from __future__ import annotations

from pathlib import Path

from replay.verbs import VERBS

_ARGUMENTS: dict[str, tuple[str, ...]] = {
    "accept": ("FILE", "--yes"),
    "compare": ("FILE", "--methods", "icp", "--steps", "STEP", "--save-csv", "OUT.csv"),
    "diff": ("FILE", "OTHER"),
    "export": ("FILE", "--what", "points", "-o", "OUT.npz"),
    "info": ("FILE",),
    "recover": ("FILE", "-o", "OUT.mcap"),
    "step": ("FILE", "--step", "STEP", "-o", "OUT.mcap"),
    "verify": ("FILE", "--step", "STEP"),
    "view": ("FILE", "--save", "OUT.rrd"),
}
assert set(_ARGUMENTS) == set(VERBS)


def verb_arguments(
    verb: str, file: Path, out: Path, *, step: int = 8, other: Path | None = None
) -> list[str]:
    """The verb and its arguments. out: name of what is written, without its suffix."""
    names = {"FILE": str(file), "OTHER": str(other or file), "STEP": str(step)}
    words = (names.get(word, word) for word in _ARGUMENTS[verb])
    return [verb, *(word.replace("OUT.", f"{out}.") for word in words)]
