"""Sessions that go on from their recordings: the same bits as if they had never stopped."""

import numpy as np
import pytest
import trimesh

import chsel
from chsel.errors import RecordingError, SettingError
from chsel.problem.poses import apply, axis_angle, compose
from replay.__main__ import main
from replay.mcap.reader import read_recording
from tests.chsel.samples import box_with_knob

SIDES = np.array([0.10, 0.06, 0.16])
TRUTH = compose(axis_angle(np.array([0.0, 0.0, 1.0]), np.array(0.4)), np.array([0.3, 0.1, 0.08]))
WORKSPACE = chsel.Workspace((0.1, -0.1, 0.0), (0.5, 0.3, 0.3))
FINGER = trimesh.creation.box(bounds=[[-0.01, -0.01, -0.06], [0.01, 0.01, 0.0]])
DOWN = np.diag([1.0, -1.0, -1.0])


def mesh():
    return box_with_knob(SIDES)[0]


def touches():
    """What is added at each step: contacts with normals, a path, a depth image, free points."""
    contacts = apply(TRUTH, box_with_knob(SIDES)[1])
    sideways = np.array([[0.0, 0.0, 1.0], [0.0, 1.0, 0.0], [-1.0, 0.0, 0.0]])
    starts = np.array([[0.12, 0.1, 0.1], [0.22, 0.1, 0.1]])
    camera = chsel.PinholeCamera(40, 30, fx=60.0, fy=60.0, cx=19.5, cy=14.5)
    above = compose(DOWN, np.array([0.3, 0.1, 0.7]))
    depth = np.full((30, 40), 0.7)
    depth[8:22, 12:28] = 0.7 - SIDES[2]
    return [
        {"contacts": contacts[:3]},
        {"hand": FINGER, "path": compose(np.stack([sideways] * 2), starts), "contact": contacts[3]},
        {
            "depth": depth,
            "camera": camera,
            "world_from_camera": above,
            "mask": depth < 0.6,
            "contacts": contacts[4:6],
        },
        {"hand": FINGER, "path": compose(np.stack([DOWN] * 2), np.add(starts, [0.0, 0.0, 0.1]))},
        {"contacts": contacts[6:10], "free": [[0.45, 0.25, 0.2], [0.15, -0.05, 0.2]]},
        {"contacts": contacts[2:14]},
    ]


def begun(path, **options):
    return chsel.Session(
        mesh(), hand=FINGER, workspace=WORKSPACE, record=path, seed=3, moves=0.0, **options
    )


def walk(session, steps, decide=()):
    """Add what is of the steps, register each, and decide after some; digests and choices."""
    seen = []
    for step in steps:
        session.add(**touches()[step])
        found = session.register()
        chosen = -1
        if step in decide:
            probe = session.next_probe()
            chosen = session.stop if probe is None else probe.action
        seen.append((found.digest, session.points.digest, str(found.trust), chosen))
    return seen


def modes(session):
    return [(mode.number, mode.weight) for mode in session.belief.modes]


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    """The recording of all steps, with what they gave and the last belief."""
    path = tmp_path_factory.mktemp("whole") / "touches.mcap"
    with begun(path) as session:
        seen = walk(session, range(6), decide=(1, 3, 5))
        return path, seen, modes(session), session.pose


@pytest.mark.parametrize("cut", [0, 1, 2, 3, 4])
def test_a_session_goes_on_to_the_bit(whole, tmp_path, cut):
    path, seen, last, pose = whole
    record = tmp_path / "on.mcap"
    with chsel.Session.resume(path, step=cut, record=record) as session:
        assert session.step == cut
        assert session.register().digest == seen[cut][0]
        rest = walk(session, range(cut + 1, 6), decide=(1, 3, 5))
        assert rest == seen[cut + 1 :]
        assert modes(session) == last
        np.testing.assert_array_equal(session.pose, pose)
    assert main(["verify", str(record)]) == 0
    assert read_recording(record).start.source != ""
    assert [probe.step for probe in read_recording(record).probes] == list(range(6))


def test_the_next_probe_is_that_of_the_session(tmp_path):
    """Decisions weigh candidates, which no recording has."""
    with begun(tmp_path / "part.mcap") as session:
        walk(session, range(2), decide=(0,))
        taken = session.next_probe().action
    session = chsel.Session.resume(tmp_path / "part.mcap", step=1)
    with pytest.raises(SettingError, match="a probe was chosen before"):
        session.next_probe()
    with begun(tmp_path / "shorter.mcap") as session:
        walk(session, range(2), decide=(0,))
    with chsel.Session.resume(tmp_path / "shorter.mcap") as session:
        assert session.next_probe().action == taken


def test_a_session_that_was_killed_goes_on(whole, tmp_path):
    """Its file ends within a registration, which does not count."""
    path, seen, _, _ = whole
    data = path.read_bytes()
    at = data.rindex(b"/trace") - 40
    cut = tmp_path / "cut.mcap"
    cut.write_bytes(data[:at])
    mended = tmp_path / "mended.mcap"
    assert main(["recover", str(cut), "-o", str(mended)]) in (0, 1)
    with chsel.Session.resume(mended) as session:
        step = session.step
        assert session.register().digest == seen[step][0]
        assert (
            walk(session, range(step + 1, 6)) == [(*one[:3], -1) for one in seen[step + 1 :]]
            or step == 5
        )


def test_another_method_begins_anew_with_all_points(whole, tmp_path):
    path, seen, _, _ = whole
    record = tmp_path / "branch.mcap"
    with chsel.Session.resume(path, step=3, method="icp", record=record) as session:
        assert session.answer is None
        assert session.points.digest == seen[3][1]
        session.register()
        walk(session, [4])
    recording = read_recording(record)
    assert recording.steps == (3, 4)
    assert recording.start.method == "icp"
    assert main(["verify", str(record)]) == 0


def test_another_policy_keeps_results_and_drops_decisions(whole, tmp_path):
    path, seen, _, _ = whole
    record = tmp_path / "branch.mcap"
    with chsel.Session.resume(path, step=3, policy="information", record=record) as session:
        assert session.register().digest == seen[3][0]
        assert session.next_probe() is not None or session.stop
    recording = read_recording(record)
    assert recording.steps == (0, 1, 2, 3)
    assert recording.decision_steps == (3,)
    assert main(["verify", str(record)]) == 0


def test_what_cannot_be_resumed_is_one_line(whole, tmp_path):
    path = whole[0]
    with pytest.raises(RecordingError, match="has no step 9; accepted: 0 to 5"):
        chsel.Session.resume(path, step=9)
    with pytest.raises(RecordingError, match="exists"):
        chsel.Session.resume(path, record=path)
    with chsel.Session(mesh(), record=tmp_path / "empty.mcap"):
        pass
    with pytest.raises(RecordingError, match=r"empty\.mcap has no probe; accepted: a new session"):
        chsel.Session.resume(tmp_path / "empty.mcap")
    other = tmp_path / "none.mcap"
    with pytest.raises(RecordingError, match=r"none\.mcap"):
        chsel.Session.resume(other)


def test_a_version_that_finds_other_values_says_so_and_ends_the_new_file(
    whole, tmp_path, monkeypatch
):
    record = tmp_path / "on.mcap"
    resumed = chsel.build_method("anchored", {"limit": 8.0})
    monkeypatch.setattr("replay.comparing.choices.Choice.build", lambda choice: resumed)
    with pytest.raises(RecordingError, match="step 1 of the recording has"):
        chsel.Session.resume(whole[0], step=1, policy="information", record=record)
    assert read_recording(record).ended.outcome.startswith("failed: step 1 of the recording has")


def test_an_object_that_moved_goes_on_to_the_bit(tmp_path):
    contacts = apply(TRUTH, box_with_knob(SIDES)[1])
    sideways = np.array([[0.0, 0.0, 1.0], [0.0, 1.0, 0.0], [-1.0, 0.0, 0.0]])
    path = compose(np.stack([sideways] * 2), np.array([[0.1, 0.1, 0.1], [0.2, 0.1, 0.1]]))
    steps = [
        {"contacts": contacts[:4]},
        {"hand": FINGER, "path": path, "contact": contacts[4]},
        {"hand": FINGER, "path": path, "contact": contacts[1] + 0.003},
        {"contacts": contacts[:6] + 0.004},
    ]

    def all_of(session, chosen):
        found = []
        for step in chosen:
            session.add(**steps[step])
            found.append((session.register().digest, session.points.digest))
        return found

    recording = tmp_path / "moved.mcap"
    with chsel.Session(mesh(), workspace=WORKSPACE, moves=0.01, record=recording) as session:
        expected = all_of(session, range(4))
    for cut in range(3):
        with chsel.Session.resume(recording, step=cut) as session:
            assert all_of(session, range(cut + 1, 4)) == expected[cut + 1 :]
