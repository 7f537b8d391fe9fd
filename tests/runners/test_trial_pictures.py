"""The pictures of a single trial: gradients of the cost, and a probing sequence."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import trimesh
from matplotlib.axes import Axes
from matplotlib.contour import QuadContourSet
from matplotlib.quiver import Quiver

from chsel.cost.cost_settings import CostSettings
from chsel.numerics.arrays import FloatArray
from chsel.problem.poses import axis_angle, compose, inverse
from chsel.problem.sdf_grid import SdfGrid
from replay.mcap.reader import Recording, read_recording
from runners.reporting.cost_gradients import (
    picture_of_gradients,
    point_gradients,
    recorded_cost,
    section_plane,
)
from runners.reporting.evaluation_folder import open_evaluation
from runners.reporting.figures import NotDrawn
from runners.reporting.method_style import method_styles
from runners.reporting.probing_sequence import picture_of_sequence, shown_steps
from runners.reporting.shown_trial import usual_trial
from runners.reporting.silhouette import CONTACT, Frame, Silhouettes
from tests.runners.drawn_figures import check_outlines
from tests.runners.made_up_evaluations import REPLAYS, add_recording, row, write_evaluation

DRILL, HAMMER = REPLAYS / "drill_chsel.mcap", REPLAYS / "hammer_icp.mcap"


def section_at(
    recording: Recording, x: FloatArray, z: FloatArray, lookup: str
) -> tuple[FloatArray, FloatArray]:
    """Signed distances (N,) and normals (N, 2) in the drawn plane, of the object's SDF grid."""
    sdf = recording.start.sdf
    inside = (sdf.values < 0.0).sum(axis=(0, 2))
    y = sdf.origin[1] + sdf.resolution * int(np.argmax(inside))
    points = np.stack([x, np.full(len(x), y), z], axis=1)
    values, gradients = sdf.at(points, lookup=lookup)
    return np.asarray(values), np.asarray(gradients)[:, [0, 2]]


def test_arrows_push_free_points_out_occupied_ones_in_and_known_ones_to_the_surface() -> None:
    recording = read_recording(DRILL)
    settings = recorded_cost(recording.start.config, "chsel")
    tolerance = settings.penetration_tolerance
    picture = picture_of_gradients(DRILL)
    figure = picture.figure
    free, occupied, known = (axes for axes in figure.axes)
    # Where each of them is pushed, and along which multiple of the outward normal.
    pushed = {
        free: (lambda s: s < tolerance, lambda s: tolerance - s),
        occupied: (lambda s: s > -tolerance, lambda s: -tolerance - s),
        known: (lambda s: abs(s) > 0.0, lambda s: -s),
    }
    for (axes, (violated, strength)), kind in zip(
        pushed.items(), ("free", "occupied", "known"), strict=True
    ):
        (arrows,) = (one for one in axes.collections if isinstance(one, Quiver))
        drawn = np.column_stack([arrows.U, arrows.V])
        written = picture.data.set_index(["x", "z"]).loc[list(zip(arrows.X, arrows.Y, strict=True))]
        written = written[written["points"] == kind][["push_x", "push_z"]].to_numpy()
        np.testing.assert_allclose(
            written / np.hypot(*written.T)[:, None], drawn / np.hypot(*drawn.T)[:, None], atol=1e-9
        )
        assert len(drawn) > 20
        distances, normals = section_at(recording, arrows.X, arrows.Y, settings.lookup)
        assert violated(distances).all(), axes.get_title()
        push = strength(distances)[:, None] * normals
        along = (drawn * push).sum(axis=1)
        lengths = np.hypot(*drawn.T) * np.hypot(*push.T)
        np.testing.assert_allclose(along, lengths, rtol=1e-6, err_msg=axes.get_title())
        order = np.argsort(np.hypot(*push.T))
        assert (np.diff(np.hypot(*drawn.T)[order]) > -1e-9).all()  # longer where more is violated
    assert [axes.get_title() for axes in figure.axes] == [
        "free points leave the object",
        "occupied points enter it",
        "surface points go to its surface",
    ]


def test_lines_of_a_section_are_the_surface_and_the_tolerance_of_each_class() -> None:
    recording = read_recording(DRILL)
    tolerance = recorded_cost(recording.start.config, "chsel").penetration_tolerance
    figure = picture_of_gradients(DRILL).figure
    levels = {0: [0.0, tolerance], 1: [0.0, -tolerance], 2: [0.0]}
    for panel, axes in enumerate(figure.axes):
        contours = [one for one in axes.collections if isinstance(one, QuadContourSet)]
        assert len(contours) == len(levels[panel])
        for contour, level in zip(contours, levels[panel], strict=True):
            vertices = np.concatenate([path.vertices for path in contour.get_paths()])
            assert len(vertices) > 20
            distances, _ = section_at(recording, *vertices.T, lookup="trilinear")
            np.testing.assert_allclose(distances, level, atol=1e-9)
        assert axes.get_xlabel() == "x in m"


def test_a_probing_sequence_shows_poses_in_the_world_and_the_contacts_so_far() -> None:
    recording = read_recording(HAMMER)
    styles = method_styles(["chsel"])
    touching = {probe.step for probe in recording.probes if len(probe.contacts)}
    last = max(touching & set(recording.steps[1:]))
    shown = [last - 1, last]  # before and after a contact
    picture = picture_of_sequence({"chsel": HAMMER}, styles, steps=shown, view="xz")
    figure = picture.figure
    assert [axes.get_title() for axes in figure.axes] == [f"step {step}" for step in shown]
    written = picture.data[picture.data["kind"] == "hypothesis"].groupby("step")
    for step, poses in written:
        expected = inverse(recording.hypotheses(step).object_from_world)
        np.testing.assert_array_equal(poses[["x", "y", "z"]], expected[:, :3, 3])
        np.testing.assert_array_equal(poses[["r00", "r01", "r02"]], expected[:, 0, :3])
    assert figure.axes[0].get_ylabel() == "CHSEL\nz in m"
    for axes, step in zip(figure.axes, shown, strict=True):
        assert axes.get_xlabel() == "x in m"
        poses = inverse(recording.hypotheses(step).object_from_world)[::-1]  # the best on top
        start, color = recording.start, styles["chsel"].color
        check_outlines(axes, start.mesh, poses, color, start.world_from_object)
        check_contacts(axes, recording, step)


def check_contacts(axes: Axes, recording: Recording, step: int) -> None:
    probes = [probe for probe in recording.probes if probe.step <= step]
    contacts = np.concatenate([probe.contacts for probe in probes])
    assert len(contacts) > 0
    orange = [line for line in axes.lines if line.get_color() == CONTACT["color"]]
    dots = [line.get_xydata()[0] for line in orange if line.get_marker() == "o"]
    np.testing.assert_array_equal(dots, contacts[:, [0, 2]])
    ways = [line.get_xydata() for line in orange if line.get_marker() != "o"]
    np.testing.assert_array_equal([way[1] for way in ways], contacts[:, [0, 2]])
    lengths = [np.hypot(*(way[1] - way[0])) for way in ways]
    assert max(lengths) == pytest.approx(0.05, abs=1e-3)  # metres, the probes move along x
    assert all(way[0][0] < way[1][0] for way in ways)


@pytest.fixture(scope="module")
def ball() -> SdfGrid:
    """A ball of radius 50 mm around (0, 0.02, 0), with exact distances at the nodes."""
    origin = np.array([-0.1, -0.08, -0.1])
    nodes = np.moveaxis(np.indices((41, 41, 41)) * 0.005, 0, -1) + origin - [0.0, 0.02, 0.0]
    radius = np.sqrt((nodes**2).sum(axis=-1))
    gradients = nodes / np.maximum(radius, 1e-12)[..., None]
    return SdfGrid(origin, 0.005, radius - 0.05, gradients)


def test_gradients_of_points_near_a_ball_are_those_of_the_paper(ball: SdfGrid) -> None:
    settings = CostSettings(-0.01, lookup="nearest", free_term="interior")
    outside, inside = [[0.08, 0.02, 0.0]], [[0.0, 0.02, 0.03]]  # s = 0.03 and -0.02
    free = point_gradients(ball, settings, np.array(outside + inside), "free")
    np.testing.assert_allclose(free, [[0, 0, 0], [0, 0, -20.0 * 0.01]], atol=1e-9)
    occupied = point_gradients(ball, settings, np.array(outside + inside), "occupied")
    np.testing.assert_allclose(occupied, [[20.0 * 0.02, 0, 0], [0, 0, 0]], atol=1e-9)
    known = point_gradients(ball, settings, np.array(outside + inside), "known")
    np.testing.assert_allclose(known, [[0.03, 0, 0], [0, 0, -0.02]], atol=1e-9)


def test_the_section_goes_through_most_of_the_object(ball: SdfGrid) -> None:
    assert ball.origin[1] + 0.005 * section_plane(ball) == pytest.approx(0.02)


def test_a_recording_tells_its_cost_or_why_there_is_no_picture(tmp_path: Path) -> None:
    start = read_recording(REPLAYS / "points_exact_descent.mcap").start
    assert recorded_cost(start.config, start.method).gradient == "exact"
    with pytest.raises(NotDrawn, match="icp, has no relaxed cost"):
        picture_of_gradients(REPLAYS / "clamp_icp.mcap")
    damaged = tmp_path / "chsel.mcap"
    damaged.write_bytes(b"no recording")
    with pytest.raises(NotDrawn, match=r"chsel\.mcap"):
        picture_of_gradients(damaged)


def test_silhouettes_are_the_projections_of_the_mesh() -> None:
    frame = Frame((0, 2), np.array([-0.2, -0.2]), np.array([0.2, 0.3]))
    box = trimesh.creation.box((0.2, 0.06, 0.1))
    silhouettes = Silhouettes(box, frame)
    mask = silhouettes.mask(np.eye(4))
    assert mask.sum() * frame.pixel**2 == pytest.approx(0.2 * 0.1, rel=0.08)
    quarter = axis_angle(np.array([0.0, 0.0, 1.0]), np.array(np.pi / 2.0))
    turned = silhouettes.mask(compose(quarter, np.array([0.1, 0.5, 0.2])))
    assert turned.sum() * frame.pixel**2 == pytest.approx(0.06 * 0.1, rel=0.12)
    right, up = (index.mean() * frame.pixel for index in np.nonzero(turned))
    assert right - 0.2 == pytest.approx(0.1, abs=0.01)
    assert up - 0.2 == pytest.approx(0.2, abs=0.01)
    assert not silhouettes.mask(compose(np.eye(3), np.array([5.0, 0.0, 0.0]))).any()


def test_steps_shown_are_those_that_all_recordings_have() -> None:
    recordings = [read_recording(REPLAYS / f"clamp_{name}.mcap") for name in ("chsel", "icp")]
    assert recordings[0].steps[0] < recordings[1].steps[0]
    assert shown_steps(recordings, None) == [10, 11]
    assert shown_steps(recordings[:1], None)[0] == 8
    assert shown_steps(recordings, [11, 10]) == [11, 10]
    with pytest.raises(NotDrawn, match="step 8 has no result"):
        shown_steps(recordings, [8])
    many = read_recording(REPLAYS / "mustard_icp.mcap")
    assert many.steps == (10, 11, 12, 13, 14, 15)
    assert shown_steps([many], None) == [10, 12, 13, 15]


def test_the_usual_trial_is_the_recorded_one_of_the_median_pd_of_the_drill(tmp_path: Path) -> None:
    diversity = {("drill", 0): 9.0, ("drill", 1): 5.0, ("drill", 2): 7.0, ("can", 0): 7.5}
    rows = [
        row(configuration, seed, "chsel", step, diversity=value if step else 100.0 - value)
        for (configuration, seed), value in diversity.items()
        for step in (0, 1, 2)
    ]
    folder = write_evaluation(tmp_path / "evaluation", rows)
    with pytest.raises(NotDrawn, match="no recordings"):
        usual_trial(open_evaluation(folder))
    for configuration, seed in diversity:
        add_recording(folder, configuration, seed, "chsel", "clamp_icp")
    trial, why = usual_trial(open_evaluation(folder))
    assert trial == ("drill", 2)
    assert why == "that of the median PD of CHSEL among those of drill"
    for seed in (0, 1, 2):
        (folder / "trials" / "drill" / f"seed_{seed}" / "chsel.mcap").unlink()
    assert usual_trial(open_evaluation(folder))[0] == ("can", 0)
    (folder / "trials" / "can" / "seed_0" / "chsel.mcap").unlink()
    with pytest.raises(NotDrawn, match="no recordings"):
        usual_trial(open_evaluation(folder))
