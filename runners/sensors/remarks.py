"""What a person should know about a log: one line a kind, with how often it happened."""

from __future__ import annotations

MOST_KINDS = 100  # a hostile log must not flood the recording
LONGEST = 400  # characters of a line


class Remarks:
    """Lines of text in the order in which their kinds came up."""

    def __init__(self, before: Remarks | None = None) -> None:
        """before: whose lines come ahead."""
        self._counts: dict[tuple[str, str], int] = dict(before._counts) if before else {}
        self._further: int = before._further if before else 0

    def warn(self, text: str, count: int = 1) -> None:
        """Something is wrong, or was left out; `count` times."""
        self._add("warning", text, count)

    def tell(self, text: str) -> None:
        """Something worth knowing."""
        self._add("info", text, 1)

    def lines(self) -> list[tuple[str, str]]:
        """Level and text of every kind; "(12 times)" stands behind what happened repeatedly."""
        lines = [
            (level, text if count == 1 else f"{text} ({count} times)")
            for (level, text), count in self._counts.items()
        ]
        if self._further:
            lines.append(("warning", f"further kinds of trouble ({self._further} times)"))
        return lines

    def _add(self, level: str, text: str, count: int) -> None:
        key = (level, text if len(text) <= LONGEST else text[: LONGEST - 1] + "…")
        if count < 1:
            return
        if key not in self._counts and len(self._counts) >= MOST_KINDS:
            self._further += count
            return
        self._counts[key] = self._counts.get(key, 0) + count
