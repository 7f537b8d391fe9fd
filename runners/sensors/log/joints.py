"""Values of joints by time."""

from __future__ import annotations

from bisect import bisect_right
from collections.abc import Mapping, Sequence

from runners.sensors.log.clocks import ClockCorrection
from runners.sensors.log.messages import Received

MOVED = 0.01  # rad or m: by which a joint must move to make another hand
MOST_OF_A_PROBE = 50

Joints = dict[str, float]


class JointHistory:
    """Values of joints by time; a state holds until the next one."""

    def __init__(self, names: Sequence[str]) -> None:
        """names: of the joints that matter."""
        self._names = tuple(names)
        self._added: list[tuple[Received, Joints]] = []
        self._states: list[tuple[int, Joints]] = []

    def add(self, received: Received, positions: Mapping[str, float]) -> None:
        """Positions of a message; joints that it does not name stay where they were."""
        last = self._added[-1][1] if self._added else {}
        state = last | {name: positions[name] for name in self._names if name in positions}
        if state.keys() != last.keys() or any(
            abs(state[name] - last[name]) > MOVED for name in state
        ):
            self._added.append((received, state))

    def settle(self, clocks: ClockCorrection) -> None:
        """All positions were added; their times are those by the clocks."""
        times = [(clocks.time(received), state) for received, state in self._added]
        self._states = sorted(times, key=lambda state: state[0])

    def first(self) -> Joints:
        """The first state; empty if there is none."""
        return self._added[0][1] if self._added else {}

    def during(self, opens: int, closes: int) -> list[tuple[int, Joints]]:
        """States from a time to before another, with the times from which they hold.

        The first one holds from `opens` on; of very many, some are left out.
        """
        start = bisect_right(self._states, opens, key=lambda state: state[0]) - 1
        chosen = [state for state in self._states[max(start, 0) :] if state[0] < closes]
        if not chosen:
            return [(opens, self.first())]
        every = -(-len(chosen) // MOST_OF_A_PROBE)
        return [(opens, chosen[0][1]), *chosen[every::every]]
