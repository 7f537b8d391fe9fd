"""The plausible samples of a motion: jumps, outliers, and publishers that contradict."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from chsel.numerics.arrays import BoolArray, FloatArray, IntArray

Distances = Callable[[IntArray, IntArray], FloatArray]
"""Function of pairs of samples, by indices (N,) and (N,): metres and radians between (N, 2)."""

_NANOSECONDS = 1e9
_NOISE = np.array([0.02, 0.1])  # m, rad: a pose may be off by this in no time at all
_STEP = np.array([0.01, 0.05])  # m, rad: shorter ways there and back do not matter
_BACK = 0.25  # of the way there: a sample is back where it was if it is nearer
_SLOW = 0.5  # of the way there: the motion before or after an outlier is slower
_BRISK = 500.0  # steps / s^2: the same, repeated, at 10 m/s^2 or 50 rad/s^2
_SUDDEN = 2500.0  # steps / s^2: there and back at 50 m/s^2 or 250 rad/s^2, beyond any arm
_WINDOW, _OFTEN = 16, 5  # so often there and back in so many samples are two publishers
_MOST_TRACKS = 8  # that a sample may continue, those of late
_OUTLIERS = 1 / 3  # of the samples of a motion beside it: fewer are outliers, not a publisher
_MANY = 0.1  # of all samples: more outliers may be of another publisher
_SHORT, _FEW = 0.05, 3  # of the samples of the longest motion, or so many: fewer are outliers


@dataclass(frozen=True)
class MotionLimits:
    """Speeds that no part of the robot reaches."""

    speed: float  # m/s
    turn: float  # rad/s

    def __str__(self) -> str:
        return f"{self.speed:g} m/s or {self.turn:g} rad/s"


@dataclass(frozen=True, eq=False)
class CheckedMotion:
    """The plausible samples of a motion, and why others are left out."""

    kept: BoolArray  # (N,)
    jumps: BoolArray  # (N,), kept samples that the one kept before them cannot have reached
    outliers: BoolArray  # (N,), left out, as the motion goes there and back too fast
    disputed: BoolArray  # (N,), left out, as two motions alternate

    def remarks(self, name: str, limits: MotionLimits) -> list[str]:
        """Return lines on what was left out; name: of what moves."""
        jumps, outliers = int(self.jumps.sum()), int(self.outliers.sum())
        disputed = int(self.disputed.sum())
        many = ", perhaps those of a second publisher" if outliers > _MANY * len(self.kept) else ""
        texts = {
            f"{name} goes there and back faster than {limits}, or more suddenly than any arm: "
            f"{outliers} of {len(self.kept)} samples are left out{many}": outliers,
            f"{name} alternates between places that are too far apart, as if two publishers sent "
            f"it: {disputed} of {len(self.kept)} samples are left out; record one of them, or "
            "raise max_speed and max_turn of the rig": disputed,
            f"{name} jumps, faster than {limits}: nothing is interpolated or swept across "
            f"{jumps} gaps": 0 if disputed else jumps,
        }
        return [text for text, count in texts.items() if count]


def check_motion(
    times: IntArray,
    distances: Distances,
    *,
    limits: MotionLimits,
    blank: BoolArray | None = None,
) -> CheckedMotion:
    """Return which samples of a motion are plausible.

    times (N,): nanoseconds, ascending. blank (N,): samples that a tracker sends without a target;
    they are outliers if the motion jumps to or from them.
    """
    outliers = np.zeros(len(times), dtype=bool)
    every = np.arange(len(times))
    if (
        blank is not None
        and not _reachable(
            times, distances, first=every[:-1], second=every[1:], limits=limits
        ).all()
    ):
        outliers |= blank
    left = np.flatnonzero(~outliers)
    alone, disputed = np.zeros((2, len(times)), dtype=bool)
    alone[left], disputed[left] = _there_and_back(times, distances, left=left)
    outliers |= alone
    left = np.flatnonzero(~outliers & ~disputed)
    too_fast = ~_reachable(times, distances, first=left[:-1], second=left[1:], limits=limits)
    if too_fast.any():
        starts = np.flatnonzero(np.append(True, too_fast))
        tracks = _tracks(times, distances, left=left, starts=starts, limits=limits)
        _choose(tracks, distances, left=left, outliers=outliers, disputed=disputed)
    kept = ~outliers & ~disputed
    chosen = np.flatnonzero(kept)
    between = np.cumsum(disputed)[chosen]
    breaks = ~_reachable(times, distances, first=chosen[:-1], second=chosen[1:], limits=limits)
    jumps = np.zeros(len(times), dtype=bool)
    jumps[chosen[1:]] = breaks | (np.diff(between) > 0)
    return CheckedMotion(kept, jumps, outliers=outliers, disputed=disputed)


def _reachable(
    times: IntArray,
    distances: Distances,
    *,
    first: IntArray,
    second: IntArray,
    limits: MotionLimits,
) -> BoolArray:
    """Return whether (N,) the way between samples is possible in the time between them."""
    seconds = np.abs(times[second] - times[first]) / _NANOSECONDS
    reach = seconds[:, None] * np.array([limits.speed, limits.turn]) + _NOISE
    possible: BoolArray = (distances(first, second) <= reach).all(axis=1)
    return possible


def _there_and_back(
    times: IntArray, distances: Distances, *, left: IntArray
) -> tuple[BoolArray, BoolArray]:
    """Return which of samples `left` (L,) are off their neighbours' way; and which alternate."""
    outliers, disputed = np.zeros((2, len(left)), dtype=bool)
    if len(left) < 3:
        return outliers, disputed
    seconds = np.diff(times[left]) / _NANOSECONDS
    steps = (distances(left[:-1], left[1:]) / _STEP).max(axis=1)
    least = np.minimum(steps[:-1], steps[1:])
    back = (least > 1.0) & _is_back(distances, left[:-2], after=left[2:], steps=least)
    # A robot that turns round was fast before and is fast after it, and does not turn at once.
    beside = np.concatenate([[np.inf], steps, [np.inf]])
    slow = np.minimum(beside[:-3], beside[3:]) < _SLOW * least
    turns = np.concatenate([[False], back, [False]])
    back &= slow | turns[:-2] | turns[2:]
    squared = seconds[:-1] * seconds[1:]
    brisk = back & (least > _BRISK * squared)
    often = np.convolve(brisk, np.ones(_WINDOW))[: len(brisk)] >= _OFTEN
    for last in np.flatnonzero(often).tolist():
        first = max(last + 1 - _WINDOW, 0)
        middles = first + np.flatnonzero(brisk[first : last + 1])
        disputed[middles[0] : middles[-1] + 3] = True
    outliers[1:-1] = back & (least > _SUDDEN * squared)
    for length in range(2, min(_FEW, len(left) - 2) + 1):
        outliers |= _short_visits(distances, left, steps=steps, seconds=seconds, length=length)
    return outliers & ~disputed, disputed


def _short_visits(
    distances: Distances, left: IntArray, *, steps: FloatArray, seconds: FloatArray, length: int
) -> BoolArray:
    """Return which of samples `left` (L,) are among `length` at one place, left as suddenly as met.

    steps, seconds (L - 1,): from each sample to the next one.
    """
    least = np.minimum(steps[:-length], steps[length:])
    between = np.max([steps[k : k - length] for k in range(1, length)], axis=0)
    visits = (least > 1.0) & (between < _SLOW * least)
    # A robot that turns round may take so many intervals for it.
    visits &= least > _SUDDEN * length * seconds[:-length] * seconds[length:]
    visits &= _is_back(distances, left[: -length - 1], after=left[length + 1 :], steps=least)
    found = np.zeros(len(left), dtype=bool)
    for first in np.flatnonzero(visits).tolist():
        found[first + 1 : first + 1 + length] = True
    return found


def _is_back(
    distances: Distances, before: IntArray, *, after: IntArray, steps: FloatArray
) -> BoolArray:
    """Return whether (N,) samples are where earlier ones were, by the lengths of ways between."""
    back: BoolArray = (distances(before, after) / _STEP).max(axis=1) < _BACK * steps
    return back


def _tracks(
    times: IntArray, distances: Distances, *, left: IntArray, starts: IntArray, limits: MotionLimits
) -> IntArray:
    """Return numbers (L,) of the motions that samples `left` (L,) belong to.

    starts: where runs of samples begin that are one motion. A run continues the motion of late that
    can have reached it.
    """
    tracks = np.zeros(len(left), dtype=np.int64)
    ends = np.append(starts[1:], len(left))
    recent: list[tuple[int, int]] = []  # last sample and number of motions, the latest first
    count = 0
    for start, end in zip(starts.tolist(), ends.tolist(), strict=True):
        lasts = np.array([last for last, _ in recent], dtype=np.int64)
        first = np.full(len(lasts), left[start])
        possible = np.flatnonzero(
            _reachable(times, distances, first=lasts, second=first, limits=limits)
        )
        if len(possible):
            number = recent.pop(int(possible[0]))[1]
        else:
            number, count = count, count + 1
        tracks[start:end] = number
        recent = [(int(left[end - 1]), number), *recent[: _MOST_TRACKS - 1]]
    return tracks


def _choose(
    tracks: IntArray,
    distances: Distances,
    *,
    left: IntArray,
    outliers: BoolArray,
    disputed: BoolArray,
) -> None:
    """Mark what is left out of samples `left` (L,) of several motions, by their numbers (L,)."""
    sizes = np.bincount(tracks)
    longest = int(sizes.argmax())
    accepted = tracks == longest
    short = sizes < max(_FEW, _SHORT * sizes[longest])
    short[longest] = False
    outliers[left[short[tracks]]] = True
    for number in np.argsort(-sizes, kind="stable").tolist()[1:]:
        if short[number]:
            break
        own = np.flatnonzero(tracks == number)
        others = np.flatnonzero(accepted)
        within = own[(own > others[0]) & (own < others[-1])]
        among = others[(others > own[0]) & (others < own[-1])]
        if len(within) == 0:
            leave_out = False
        elif len(among) == 0:
            # It left a place, and comes back to it.
            place = int(np.searchsorted(others, own[0]))
            way = left[[others[place - 1], own[0], own[-1], others[place]]]
            steps = (distances(way[:-1:2], way[1::2]) / _STEP).max(axis=1)
            leave_out = bool(
                _is_back(distances, way[:1], after=way[-1:], steps=steps.min(keepdims=True))[0]
            )
        else:
            leave_out = len(within) < _OUTLIERS * len(among)
            if not leave_out:
                common = slice(max(own[0], others[0]), min(own[-1], others[-1]) + 1)
                disputed[left[common]] = ~outliers[left[common]]
        if leave_out:
            outliers[left[own]] = True
        else:
            accepted[own] = True
