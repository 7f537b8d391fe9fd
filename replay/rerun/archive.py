"""The archive of quality-diversity search as a heat map over its first two measures."""

from __future__ import annotations

from functools import cache
from typing import NamedTuple

import numpy as np
import rerun as rr

from chsel.numerics.arrays import FloatArray, IntArray
from chsel.problem.registration_problem import ArchiveSnapshot, Hypotheses
from replay.colors import EMPTY_CELL, ColorArray, CostScale, cost_colors, number
from replay.rerun.clock import ITERATION, PROBE, REGISTRATION
from replay.rerun.hypotheses import shown_hypotheses
from replay.rerun.plane import Frame, Label, color_array, lines, on_screen, texts, ticks

_FLATTEST = 4  # a map wider or higher than this has its shorter side stretched
_MARK = (255, 255, 255)
_AT_ONCE = 8  # snapshots that are sent together
_BAR = (0.06, 0.11)  # left and right edge of the colour bar, beyond the map, in map widths


class _Moment(NamedTuple):
    """A snapshot as it is drawn; costs, colors: the bytes of the two pictures."""

    step: int
    moment: int
    costs: bytes
    colors: bytes
    labels: list[Label]


class ArchiveMap:
    """Draws snapshots of archives under the entity `root`; a unit of the view is one cell."""

    def __init__(self, stream: rr.RecordingStream, root: str = "archive") -> None:
        self._stream = stream
        self._root = root
        self._scale: CostScale | None = None
        self._last: ArchiveSnapshot | None = None
        self._framed: Frame | None = None
        self._waiting: list[_Moment] = []

    def start(self) -> None:
        """A registration starts, with a new archive: the marks on the last one are gone."""
        self.send()
        self._scale = self._last = None
        self._mark(np.zeros((0, 2)), [])

    def draw(self, step: int, moment: int, archive: ArchiveSnapshot) -> None:
        """The lowest cost in each cell, empty cells in grey; axes, colour bar and a caption.

        moment: on the timeline of iterations. What is drawn is sent in blocks.
        """
        scale = CostScale.of(-archive.objectives)
        scale = scale if self._scale is None else self._scale.including(scale)
        self._scale, self._last = scale, archive
        costs, frame = lowest_costs(archive), map_frame(archive)
        colors = heat_map(costs, scale)
        if frame != self._framed:
            self.send()
            self._framed = frame
            self._lay_out(frame, costs.shape, colors.shape[:2])
        labels = _labels(archive, frame, scale, step)
        self._waiting.append(_Moment(step, moment, costs.tobytes(), colors.tobytes(), labels))
        if len(self._waiting) == _AT_ONCE:
            self.send()

    def send(self) -> None:
        """Send what is drawn and not sent yet."""
        drawn, self._waiting = self._waiting, []
        if not drawn:
            return
        times = [
            rr.TimeColumn(PROBE, sequence=[one.step for one in drawn]),
            rr.TimeColumn(REGISTRATION, sequence=[one.step for one in drawn]),
            rr.TimeColumn(ITERATION, sequence=[one.moment for one in drawn]),
        ]
        costs = rr.Image.columns(buffer=[one.costs for one in drawn])
        colors = rr.Image.columns(buffer=[one.colors for one in drawn])
        labels = [label for one in drawn for label in one.labels]
        axes = rr.Points2D.columns(
            positions=np.array([label[:2] for label in labels], dtype=np.float32),
            labels=[label[2] for label in labels],
        ).partition([len(one.labels) for one in drawn])
        for name, columns in (("cost", costs), ("colors", colors), ("axes", axes)):
            self._stream.send_columns(f"{self._root}/{name}", times, columns)

    def _lay_out(self, frame: Frame, costs: tuple[int, int], colors: tuple[int, int]) -> None:
        """What stays from one snapshot to the next."""
        # The costs lie under the colours, so that the viewer shows them where the mouse points.
        self._log("cost", _layer(costs, "L", rr.ChannelDatatype.F32, -30.0))
        self._log("colors", _layer(colors, "RGBA", rr.ChannelDatatype.U8, -20.0))
        self._log("axes", texts([]))
        self._log("frame", lines(frame.outline()))

    def mark(self, step: int, moment: int, hypotheses: Hypotheses) -> None:
        """Mark the cells that the hypotheses come from, each with its cost."""
        if self._last is None and hypotheses.archive is not None:
            self.draw(step, moment, hypotheses.archive)
        if self._last is None:
            return
        shown = shown_hypotheses(hypotheses)
        shown = shown[hypotheses.cell[shown] >= 0]
        frame = map_frame(self._last)
        columns, rows = _places(self._last, hypotheses.cell[shown])
        x = frame.x(1.0) * (columns + 0.5) / self._last.shape[0]
        y = frame.height * (1.0 - (rows + 0.5) / _rows(self._last))
        costs = hypotheses.cost[shown].tolist()
        self._mark(np.stack([x, y], axis=1), [f"cost {number(cost)}" for cost in costs])

    def _mark(self, places: FloatArray, labels: list[str]) -> None:
        points = rr.Points2D(
            places.astype(np.float32),
            labels=labels,
            show_labels=False,
            colors=color_array(_MARK),
            radii=on_screen(2.5),
        )
        self._log("hypotheses", points)

    def _log(self, name: str, what: rr.AsComponents) -> None:
        self._stream.log(f"{self._root}/{name}", what)


def map_frame(archive: ArchiveSnapshot) -> Frame:
    """Size of the map, in cells: one measure alone makes a strip."""
    across, up = _stretch(archive)
    return Frame(archive.shape[0] * across, _rows(archive) * up)


def lowest_costs(archive: ArchiveSnapshot) -> np.ndarray:
    """The map (height, width) as float32: the lowest cost over all further measures, NaN if empty.

    The first measure runs to the right, the second upwards; the map has the size of `map_frame`.
    """
    columns, rows = _places(archive, archive.cells)
    costs = np.full((_rows(archive), archive.shape[0]), np.inf)
    np.minimum.at(costs, (len(costs) - 1 - rows, columns), -archive.objectives)
    costs[np.isinf(costs)] = np.nan
    across, up = _stretch(archive)
    return np.repeat(np.repeat(costs, up, axis=0), across, axis=1).astype(np.float32)


def heat_map(costs: np.ndarray, scale: CostScale) -> ColorArray:
    """The picture (height, width', 4) of costs (height, width), with the colour bar beside it."""
    picture = _empty_map(*costs.shape).copy()
    filled = ~np.isnan(costs)
    picture[:, : costs.shape[1], :3][filled] = cost_colors(scale.fraction(costs[filled]))
    return picture


@cache
def _empty_map(height: int, width: int) -> ColorArray:
    """The picture of an archive without a solution."""
    left, right = _bar_edges(width)
    picture = np.zeros((height, right, 4), dtype=np.uint8)
    picture[:, :width] = (*EMPTY_CELL, 255)
    picture[:, left:, :3] = cost_colors((np.arange(height) + 0.5) / height)[:, None]
    picture[:, left:, 3] = 255
    return picture


def _layer(
    shape: tuple[int, int], color_model: str, kind: rr.ChannelDatatype, draw_order: float
) -> rr.Image:
    """All of a picture but its pixels."""
    height, width = shape
    layout = rr.encodings.ImageFormat(
        width, height, color_model=rr.ColorModel.auto(color_model), channel_datatype=kind
    )
    opacity = None if color_model == "L" else 1.0
    return rr.Image.from_fields(format=layout, opacity=opacity, draw_order=draw_order)


def _bar_edges(width: int) -> tuple[int, int]:
    left = width + max(1, round(_BAR[0] * width))
    return left, left + max(1, round((_BAR[1] - _BAR[0]) * width))


def _stretch(archive: ArchiveSnapshot) -> tuple[int, int]:
    """By how much a cell is drawn wider and higher, so that the map is not a thin line."""
    width, height = archive.shape[0], _rows(archive)
    return max(1, height // (_FLATTEST * width)), max(1, width // (_FLATTEST * height))


def _rows(archive: ArchiveSnapshot) -> int:
    return archive.shape[1] if len(archive.shape) > 1 else 1


def _places(archive: ArchiveSnapshot, cells: IntArray) -> tuple[IntArray, IntArray]:
    """Column and row of cells, along the first two measures."""
    indices = np.unravel_index(cells, archive.shape)
    columns = np.asarray(indices[0], dtype=np.int64)
    rows = np.asarray(indices[1], dtype=np.int64) if len(indices) > 1 else np.zeros_like(columns)
    return columns, rows


def _labels(archive: ArchiveSnapshot, frame: Frame, scale: CostScale, step: int) -> list[Label]:
    """Caption, tick values and axis names."""
    pad = 0.04 * max(frame.width, frame.height)
    caption = (
        f"probe {step}, iteration {archive.iteration}"
        + (f", refinement {archive.refinement}" if archive.refinement else "")
        + f": {len(archive.cells)} of {int(np.prod(archive.shape))} cells filled"
    )
    middle = frame.width / 2
    labels: list[Label] = [(middle, -3.6 * pad, caption)]
    labels += [(frame.x(f), frame.height + 0.3 * pad, text) for f, text in _ticks(archive, 0)]
    labels += [(middle, frame.height + 2.2 * pad, archive.measure_names[0])]
    if len(archive.shape) > 1:
        labels += [(-1.4 * pad, frame.y(f) - 0.6 * pad, text) for f, text in _ticks(archive, 1)]
        labels += [(0.0, -1.9 * pad, archive.measure_names[1])]
    if len(archive.shape) > 2:
        others = ", ".join(archive.measure_names[2:])
        labels += [(middle, frame.height + 3.9 * pad, f"lowest cost over {others}")]
    left, right = _bar_edges(round(frame.width))
    places = [0.0, 0.5, 1.0] if scale.high > scale.low else [0.0]
    for place in places:
        text = number(scale.cost_at(place))
        labels.append((right + 1.8 * pad, frame.y(1.0 - place) - 0.6 * pad, text))
    labels.append(((left + right) / 2, -1.9 * pad, "cost"))
    return labels


def _ticks(archive: ArchiveSnapshot, measure: int) -> list[tuple[float, str]]:
    """Round values of a measure: their place along its axis, in [0, 1], and their text."""
    lower, upper = float(archive.lower[measure]), float(archive.upper[measure])
    span = upper - lower if upper > lower else 1.0
    return [((value - lower) / span, number(value)) for value in ticks(lower, upper)]
