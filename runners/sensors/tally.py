"""What became of a session's images: how many were used, and what was left out."""

from __future__ import annotations

from dataclasses import dataclass, field


@dataclass
class Tally:
    """Counts of one sensor in one probe.

    images: that came. used: that told of free space or of contacts. spared: left out by the rig's
    rate, or as nothing had moved. lost: without a transform. unusable: of another size than the
    camera's, or without a single pixel that counts. pixels: of the images that were looked at;
    invalid, edges: of these without a depth within range, and beside an occluding edge. touching:
    pixels in contact. outside: points of a cloud that are out of reach. contacts: points. free:
    voxels that it was the first to tell of.
    """

    images: int = 0
    used: int = 0
    spared: int = 0
    lost: int = 0
    unusable: int = 0
    pixels: int = 0
    invalid: int = 0
    edges: int = 0
    touching: int = 0
    outside: int = 0
    contacts: int = 0
    free: int = 0

    def add(self, other: Tally) -> None:
        """Add the counts of another one."""
        for name, value in vars(other).items():
            setattr(self, name, getattr(self, name) + value)


@dataclass
class Report:
    """Tallies of a session by step and by the name of a sensor, and its lines of text."""

    tallies: dict[int, dict[str, Tally]] = field(default_factory=dict)
    lines: list[tuple[str, str]] = field(default_factory=list)

    def of(self, step: int, sensor: str) -> Tally:
        """The tally to count in."""
        return self.tallies.setdefault(step, {}).setdefault(sensor, Tally())

    def total(self) -> dict[str, Tally]:
        """By sensor, over all probes."""
        totals: dict[str, Tally] = {}
        for tallies in self.tallies.values():
            for name, tally in tallies.items():
                totals.setdefault(name, Tally()).add(tally)
        return totals
