"""Ctrl-C that waits for a moment at which nothing is half written."""

from __future__ import annotations

import signal
from types import FrameType
from typing import Self


class Interrupt:
    """Within this context the first Ctrl-C is remembered, and the second takes effect at once."""

    def __init__(self) -> None:
        self._asked = False
        self._previous = signal.getsignal(signal.SIGINT)

    def __enter__(self) -> Self:
        signal.signal(signal.SIGINT, self._remember)
        return self

    def __exit__(self, *_: object) -> None:
        signal.signal(signal.SIGINT, self._previous)

    def check(self) -> None:
        """Raise KeyboardInterrupt if Ctrl-C was pressed."""
        if self._asked:
            raise KeyboardInterrupt

    def _remember(self, _: int, __: FrameType | None) -> None:
        if self._asked:
            raise KeyboardInterrupt
        self._asked = True
