"""Makes the dataset beside it, by LeRobot 0.4.4: `python make_dataset.py FOLDER`.

Episode 1 is the log of test_forces.py: a hand that goes along x, and a force on it; episode 0 is of
three rows. Two joints turn as the hand goes, and one of three taxels is pressed.
"""

import sys
from pathlib import Path

import numpy as np
from lerobot.datasets.lerobot_dataset import LeRobotDataset

from tests.runners.sensors.test_forces import WEIGHT, hand_pose, wrench

HALF = 0.5**0.5
FEATURES = {
    "observation.state": ("float32", 8),  # x y z (mm), qw qx qy qz, gripper
    "observation.wrench": ("float32", 6),
    "observation.joints": ("float32", 2),  # degrees
    "observation.taxels": ("float32", 3),
    "probe": ("int64", 1),
}


def frame(seconds):
    """The values of a row; the hand's rotation is that of `hand_pose`, a quarter about y."""
    place = 1000.0 * hand_pose(seconds)[:3, 3]
    within = 1.0 <= seconds < 3.0
    return {
        "observation.state": np.array([*place, HALF, 0.0, HALF, 0.0, 0.5], np.float32),
        "observation.wrench": (wrench(seconds) + WEIGHT).astype(np.float32),
        "observation.joints": np.array([10.0 * seconds, -5.0 * seconds], np.float32),
        "observation.taxels": np.array([0.1, 0.9 if within else 0.1, 0.2], np.float32),
        "probe": np.array([0 if within else -1]),
        "task": "touch",
    }


if __name__ == "__main__":
    dataset = LeRobotDataset.create(
        "local/touch",
        fps=100,
        root=Path(sys.argv[1]),
        features={
            name: {"dtype": dtype, "shape": (size,), "names": None}
            for name, (dtype, size) in FEATURES.items()
        },
        use_videos=False,
    )
    for count in (3, 401):
        for tick in range(count):
            dataset.add_frame(frame(0.01 * tick))
        dataset.save_episode()
    dataset.finalize()
