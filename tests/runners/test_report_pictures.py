"""What the report's pictures and numbers are made of."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import trimesh

from chsel.cost.cost_settings import CostSettings
from chsel.problem.poses import axis_angle, compose
from chsel.problem.sdf_grid import SdfGrid
from replay.mcap.reader import read_recording
from runners.reporting.cost_gradients import (
    picture_of_gradients,
    point_gradients,
    recorded_cost,
    section_plane,
)
from runners.reporting.evaluation_folder import last_half, open_evaluation
from runners.reporting.figures import NotDrawn
from runners.reporting.method_style import method_styles
from runners.reporting.probing_sequence import shown_steps
from runners.reporting.shown_trial import usual_trial
from runners.reporting.silhouette import Frame, Silhouettes
from runners.reporting.statistics import spreads
from runners.reporting.tables import median_cells, number
from tests.runners.made_up_evaluations import METHODS, REPLAYS, add_recording, row, write_evaluation


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


def test_the_last_half_is_that_of_all_methods_of_a_trial() -> None:
    rows = [row("can", 0, "chsel", step) for step in (3, 4, 5, 6)]
    rows += [row("can", 0, "icp", step) for step in (7, 8)] + [row("can", 1, "icp", 3)]
    kept = last_half(pd.DataFrame(rows))[["seed", "method", "step"]]
    assert list(kept.itertuples(index=False, name=None)) == [
        (0, "chsel", 6),
        (0, "icp", 7),
        (0, "icp", 8),
        (1, "icp", 3),
    ]


def test_quartiles_are_of_the_numbers_that_there_are() -> None:
    numbers = {"a": [4.0, None, 1.0, None, 3.0, 2.0], "b": [2.5, 2.5], "c": [None, None, None]}
    rows = [{"of": of, "number": value} for of, values in numbers.items() for value in values]
    found = spreads(pd.DataFrame(rows), "of", "number")
    assert found.loc["a"].to_dict() == pytest.approx(
        {
            "count": 4,
            "left_out": 2,
            "lower": 1.75,
            "median": 2.5,
            "upper": 3.25,
            "mean": 2.5,
            "deviation": 1.25**0.5,
        }
    )
    cells = median_cells(found, "min")
    assert [cell.text for cell in cells] == ["2.5", "2.5", "-"]
    assert [cell.best for cell in cells] == [True, True, False]
    assert [cell.note for cell in cells] == ["2 left out", "n 2", "3 left out"]


@pytest.mark.parametrize(
    ("value", "text"),
    [(0.0, "0"), (12.345, "12.3"), (999.7, "1000"), (12345.6, "12346"), (0.000123, "1.23e-04")],
)
def test_numbers_have_three_digits_that_count(value: float, text: str) -> None:
    assert number(value) == text


def test_a_method_looks_the_same_in_every_figure_and_like_no_other() -> None:
    names = [*METHODS, "chsel@paper", "mine", "icp#small"]
    styles = method_styles(names)
    assert len({style.color for style in styles.values()}) == len(names)
    assert len({style.marker for style in styles.values()}) == len(names)
    assert method_styles(["icp", "svgd"])["icp"] == styles["icp"]
    assert list(method_styles(names[::-1])) == list(styles)
