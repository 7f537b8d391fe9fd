"""A policy of your own: from above where that is nearly as good, as your robot likes it best."""

from dataclasses import dataclass
from typing import Annotated

from own_robot import FINGER, MUSTARD, TABLE, TRUTH, FakeRobot

import chsel
from chsel.policies.policies import information
from chsel.policies.policy import ConfiguredPolicy, PolicySettings
from chsel.problem.settings import not_negative


@dataclass(frozen=True)
class FromAboveSettings(PolicySettings):
    bonus: Annotated[float, not_negative] = 0.5  # nats, for an action from above


class FromAbove(ConfiguredPolicy[FromAboveSettings]):
    settings_class = FromAboveSettings

    def rate(self, problem, forecast):
        """Scores (A,): what an action tells about the pose, nats, and the bonus."""
        downward = problem.actions.world_from_hand[:, 2, 2] < -0.9  # the z axis of the hand
        return information(problem, forecast) + self.settings.bonus * downward


for bonus in (0.0, 0.5):
    robot = FakeRobot(chsel.load_mesh(MUSTARD), TRUTH)
    policy = FromAbove(FromAboveSettings(bonus=bonus, probes=8))
    downward = 0
    with chsel.Session(MUSTARD, hand=FINGER, workspace=TABLE, policy=policy) as session:
        while (probe := session.next_probe()) is not None:
            path, contact = robot.touch(probe.world_from_hand, probe.length)
            session.add(hand=FINGER, path=path, contact=contact)
            session.register()
            downward += int(probe.world_from_hand[2, 2] < -0.9)
    apart = 1e3 * session.trust.spread
    print(f"bonus {bonus}: {downward} of 8 touches from above, then poses {apart:.0f} mm apart")
