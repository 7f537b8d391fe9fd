"""The report of a source on its log: counts by sensor and probe, and warnings."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, field


@dataclass
class Counts:
    """Counts of one sensor in one probe."""

    images: int = 0  # that came, or clouds, forces, poses of the hand
    used: int = 0  # of them, that gave free space or contacts
    spared: int = 0  # left out by the rig's rate, or as nothing had moved
    lost: int = 0  # without a transform
    unusable: int = 0  # of another size than the camera's, or without a pixel that counts
    pixels: int = 0  # of the images that were looked at, or points of clouds
    invalid: int = 0  # pixels without a depth within range
    edges: int = 0  # pixels beside a jump of depth
    outline: int = 0  # pixels at the outline of the object's label
    small: int = 0  # pixels or points in regions that are too small
    far: int = 0  # pixels or points in regions too far from the largest to be of one object
    outside: int = 0  # points of a cloud, or lines of force, that are out of reach
    spikes: int = 0  # forces above the threshold in too few messages in a row
    touching: int = 0  # pixels in contact
    contacts: int = 0  # points
    free: int = 0  # voxels that it was the first to mark as free

    def unused(self) -> str:
        """Return how many messages were not used, by reason."""
        reasons = {
            "outside of probes, or too soon after others": self.spared,
            "without a pose": self.lost,
            "unusable": self.unusable,
        }
        return ", ".join(f"{count} {reason}" for reason, count in reasons.items() if count)

    def left_out(self) -> str:
        """Return how many pixels, points or forces were left out, by reason; "" if none were."""
        reasons = {
            "without a value in range": self.invalid,
            "at edges of depth": self.edges,
            "at the label's outline": self.outline,
            "in regions too small": self.small,
            "in regions too far from the largest": self.far,
            "out of reach": self.outside,
            "of forces that do not last": self.spikes,
        }
        counts = ", ".join(f"{count} {reason}" for reason, count in reasons.items() if count)
        total = f"{self.pixels} pixels or points" if self.pixels else f"{self.images} messages"
        return f"left out of {total}: {counts}" if counts else ""


@dataclass
class Report:
    """Counts of a session by step and by the name of a sensor, and its lines of text."""

    by_probe: dict[int, dict[str, Counts]] = field(default_factory=dict)
    lines: list[tuple[str, str]] = field(default_factory=list)

    def counts(self, step: int, sensor: str) -> Counts:
        """Return the counts of a sensor in a probe."""
        return self.by_probe.setdefault(step, {}).setdefault(sensor, Counts())

    def total(self) -> dict[str, Counts]:
        """Return the counts of each sensor over all probes."""
        totals: dict[str, Counter[str]] = {}
        for by_sensor in self.by_probe.values():
            for name, counts in by_sensor.items():
                totals.setdefault(name, Counter()).update(vars(counts))
        return {name: Counts(**counts) for name, counts in totals.items()}


class LogWarnings:
    """Lines of text in the order in which their kinds came up."""

    def __init__(self) -> None:
        self._counts: Counter[tuple[str, str]] = Counter()

    def warn(self, text: str, count: int = 1) -> None:
        """Add a line: something is wrong, or was left out; `count` times."""
        if count:
            self._counts["warning", text] += count

    def note(self, text: str) -> None:
        """Add a line: something worth knowing."""
        self._counts["info", text] += 1

    def lines(self) -> list[tuple[str, str]]:
        """Return level and text of every kind, with "(12 times)" behind what was repeated."""
        return [
            (level, text if count == 1 else f"{text} ({count} times)")
            for (level, text), count in self._counts.items()
        ]
