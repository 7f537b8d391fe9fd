"""How the joints that move the hand stood over time."""

from __future__ import annotations

from bisect import bisect_right
from collections.abc import Mapping, Sequence

MOVED = 0.01  # rad or m: by which a joint must move to make another hand
MOST_STATES = 100_000  # of a log
MOST_OF_A_PROBE = 50

Joints = dict[str, float]


class JointHistory:
    """Values of joints by time; a state holds until the next one."""

    def __init__(self, names: Sequence[str]) -> None:
        """names: of the joints that matter."""
        self._names = tuple(names)
        self._states: list[tuple[int, Joints]] = []

    def add(self, time: int, positions: Mapping[str, float]) -> None:
        """What a message said; joints that it does not name stay where they were."""
        told = {name: positions[name] for name in self._names if name in positions}
        state = (self._states[-1][1] if self._states else {}) | told
        if told and len(self._states) < MOST_STATES and self._moved(state):
            self._states.append((time, state))

    def first(self) -> Joints:
        """The first state; empty if there is none."""
        return self._states[0][1] if self._states else {}

    def during(self, opens: int, closes: int) -> list[tuple[int, Joints]]:
        """States from a time to before another, with the times from which they hold.

        The first one holds from `opens` on; of very many, some are left out.
        """
        states = sorted(self._states, key=lambda state: state[0])
        times = [time for time, _ in states]
        start = bisect_right(times, opens) - 1
        chosen = [(time, joints) for time, joints in states[max(start, 0) :] if time < closes]
        if not chosen:
            return [(opens, self.first())]
        every = -(-len(chosen) // MOST_OF_A_PROBE)
        return [(opens, chosen[0][1]), *chosen[every::every]]

    def _moved(self, state: Joints) -> bool:
        if not self._states or state.keys() != self._states[-1][1].keys():
            return True
        last = self._states[-1][1]
        return any(abs(state[name] - last[name]) > MOVED for name in state)
