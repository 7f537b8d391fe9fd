"""The console scripts: `chsel-probe` is `python -m runners.probe`, and so on."""

from __future__ import annotations

from collections.abc import Callable
from importlib import import_module

from replay.startup import begin
from runners.command.at_once import answer_at_once


def _script(command: str) -> Callable[[], None]:
    def run() -> None:
        begin()
        answer_at_once(command, installed=True)
        import_module(f"runners.{command}").main()

    return run


align = _script("align")
benchmark = _script("benchmark")
evaluate = _script("evaluate")
fetch = _script("fetch")
plausible = _script("plausible")
probe = _script("probe")
published = _script("published")
real = _script("real")
report = _script("report")
simulate_rig = _script("simulate_rig")
