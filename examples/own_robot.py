"""A robot feels for an object until it is sure of the pose. Put yours in place of FakeRobot."""

from pathlib import Path

import numpy as np
import trimesh

import chsel

MUSTARD = Path(__file__).parents[1] / "runners/objects/models/mustard.ply"
FINGER = trimesh.creation.box((0.008, 0.008, 0.06))  # in the hand's frame, metres; probes along z
TABLE = chsel.Workspace((0.35, 0.0, 0.0), (0.55, 0.2, 0.2))  # where the object can be, metres
TRUTH = trimesh.transformations.rotation_matrix(0.7, [0, 0, 1])  # world_from_object
TRUTH[:3, 3] = 0.45, 0.1, 0.0


class FakeRobot:
    def __init__(self, mesh, world_from_object):
        self.scene = mesh.copy().apply_transform(world_from_object)

    def touch(self, start, length):
        """Move the hand along its z axis: its path (2, 4, 4), and the contact (3,) or None."""
        along = start[:3, 2]
        tip = start[:3, 3] + 0.03 * start[:3, 2]
        hits = self.scene.ray.intersects_location([tip], [along])[0]
        way = min([length, *((hits - tip) @ along)])
        end = start + np.outer([*(way * along), 0.0], [0.0, 0.0, 0.0, 1.0])
        return [start, end], tip + way * along if way < length else None


if __name__ == "__main__":
    robot = FakeRobot(chsel.load_mesh(MUSTARD), TRUTH)
    policy = chsel.build_policy("information", {"stop": {"spread": 0.004, "gain": 0.0}})
    with chsel.Session(MUSTARD, hand=FINGER, workspace=TABLE, policy=policy) as session:
        while (probe := session.next_probe()) is not None:
            path, contact = robot.touch(probe.world_from_hand, probe.length)
            session.add(hand=FINGER, path=path, contact=contact)
            apart = 1e3 * session.register().trust.spread
            print(f"touch {session.step}: {session.outcome}, poses {apart:.0f} mm apart")
    error = np.linalg.norm((session.answer.world_from_object[0] - TRUTH)[:3, 3])
    print(f"stopped by {session.stop}: the best pose is off by {1e3 * error:.1f} mm")
