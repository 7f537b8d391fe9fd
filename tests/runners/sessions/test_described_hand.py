"""Kinematic and simulated sessions with a hand from a URDF file."""

import re
from dataclasses import replace

import numpy as np
import pytest
import trimesh

from chsel.errors import SettingError
from chsel.next_probe.action_lattice import ActionSettings
from chsel.problem.poses import apply, inverse
from chsel.problem.sdf_grid import mesh_sdf
from chsel.problem.settings import build_settings
from runners.sessions.physics_engine import ENGINES
from runners.sessions.probing import open_probing
from runners.sessions.probing_hand import DescribedHand, open_hand
from runners.sessions.probing_settings import ProbingSettings

STICK = """<robot name="stick">
  <link name="arm"><collision><geometry><sphere radius="0.4"/></geometry></collision></link>
  <joint name="flange" type="fixed"><parent link="arm"/><child link="stick"/></joint>
  <link name="stick">
    <collision>
      <origin xyz="0 0 0.06"/><geometry><box size="0.03 0.03 0.12"/></geometry>
    </collision>
    <collision>
      <origin xyz="0.02 0 -0.02"/><geometry><box size="0.08 0.06 0.04"/></geometry>
    </collision>
  </link>
</robot>"""


@pytest.fixture
def stick(tmp_path):
    path = tmp_path / "stick.urdf"
    path.write_text(STICK)
    return DescribedHand(urdf=str(path), root="stick")


def test_a_hand_from_a_urdf_probes_along_its_z_axis(stick):
    hand = open_hand(stick)
    np.testing.assert_allclose(
        hand.shape.bounds, [[-0.02, -0.03, -0.04], [0.06, 0.03, 0.12]], atol=1e-12
    )
    heights = hand.shape.front.heights
    assert set(heights[np.isfinite(heights)].round(9).tolist()) == {0.0, 0.12}
    points = hand.surface_points(0.005)  # forward is x, and x of the hand is -z
    at_end = points[np.abs(points[:, 0] - 0.12) < 1e-9]
    assert len(at_end) >= 9
    assert np.abs(at_end[:, 1:]).max() == pytest.approx(0.015)
    depth = [-mesh_sdf(solid, points)[0] for solid in hand.solids]
    assert np.max(depth) < 1e-9


@pytest.mark.parametrize("engine", [None, *ENGINES])
def test_all_engines_touch_with_the_described_hand(engine, stick):
    box = trimesh.creation.box((0.2, 0.3, 0.3))
    settings = replace(ProbingSettings(), hand=stick, noise=0.0, engine=engine)
    kind = "kinematic" if engine is None else "simulated"
    if engine is not None:
        pytest.importorskip(engine, reason=f"{engine} is not installed")
    session = open_probing(kind, box, configuration_name="can", settings=settings, seed=0)
    actions = session.offer(ActionSettings(choice="configuration"))
    face = apply(session.world_from_object, np.asarray(box.vertices))[:, 0].min()
    (probe,) = session.take(0, 1)  # y 0, z 0.12
    assert probe.gripper_path[:, 0, 3].max() == pytest.approx(face - 0.12, abs=1e-3)
    np.testing.assert_allclose(probe.contacts[0, 0], face, atol=1e-3)
    assert np.abs(probe.contacts[0, 1:] - [0.0, 0.12]).max() < 0.0155
    assert session.hand.digest == open_hand(stick).shape.digest
    # Behind the stick there is no more hand than the URDF has.
    free = probe.new_points.free
    assert len(free) > 8
    beside = free - actions.world_from_hand[1, :3, 3]
    assert np.abs(beside[:, 1]).max() < 0.03 + 0.0125
    inside = mesh_sdf(box, apply(inverse(session.world_from_object), free))[0]
    assert inside.min() > -(0.5 * np.sqrt(3.0) * 0.025 - 0.010)
    session.close()


def opened(hand):
    settings = build_settings(ProbingSettings, {"hand": hand}, where="session")
    open_probing(
        "kinematic",
        trimesh.creation.box((0.2, 0.3, 0.3)),
        configuration_name="can",
        settings=settings,
        seed=0,
    )


@pytest.mark.parametrize(
    ("hand", "message"),
    [
        ({"urdf": "nowhere.urdf"}, "hand.urdf nowhere.urdf does not exist; accepted: a URDF file"),
        ({"urdf": "STICK"}, "the hand is 0.8 m long; accepted: at most 0.5. Choose the link"),
        ({"urdf": "STICK", "root": "thumb"}, "hand.root 'thumb' is not one of"),
        ({"root": "stick"}, "hand.root without hand.urdf; accepted: both, or neither"),
        ({"boxes": [{"size": [0.01, 0.01, 0.1]}]}, "no interior point 0.01 m deep; accepted: a"),
        ({"boxes": [{"size": [0.1, -0.1, 0.1]}]}, "size is -0.1"),
    ],
)
def test_a_hand_that_cannot_be_is_an_error(hand, message, stick):
    if hand.get("urdf") == "STICK":
        hand = {**hand, "urdf": stick.urdf}

    with pytest.raises(SettingError, match=re.escape(message)):
        opened(hand)
