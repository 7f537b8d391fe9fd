"""All sections of a report on an evaluation, in their order."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

from chsel.errors import require_choice
from runners.reporting.against_baseline import section_against
from runners.reporting.box_plots import picture_of_boxes
from runners.reporting.completeness import (
    completeness_table,
    failures_table,
    objects_table,
    planned_methods,
)
from runners.reporting.cost_gradients import picture_of_gradients
from runners.reporting.evaluation_folder import Evaluation, ReportError, Row, Trial
from runners.reporting.faults_section import sections_on_faults
from runners.reporting.method_style import MethodStyle, method_styles
from runners.reporting.over_iterations import picture_over_iterations, tables_over_iterations
from runners.reporting.over_probes import picture_over_probes
from runners.reporting.probing_sequence import picture_of_sequence
from runners.reporting.registration_times import picture_of_times, table_of_times
from runners.reporting.section import NotDrawn, Picture, Section, Table
from runners.reporting.shown_trial import named_trial, usual_trial
from runners.reporting.silhouette import VIEWS
from runners.reporting.statistics import last_half
from runners.reporting.tables import method_table
from runners.reporting.true_pose_table import true_pose_sections

Styles = Mapping[str, MethodStyle]
Best = Callable[[Sequence[float]], float] | None
_LAST_HALF = (
    "Numbers are pooled over trials (a configuration with a seed) and over the steps of the last "
    "half of every trial."
)
_OF_SEQUENCE = ("chsel", "medial_constraint", "icp")
_VIEW_NAMES = {
    "xz": "from the side, with the probing direction x to the right",
    "xy": "from above, with the probing direction x to the right",
    "yz": "along the probing direction x",
}


@dataclass(frozen=True)
class SequenceConfig:
    """What the pictures of a single trial show.

    trial: such as "drill/0"; by default that of the median PD of CHSEL. methods: by default those
    of the paper's picture. steps: by default four of those that all methods have. view: the axes
    of the world that are drawn.
    """

    trial: str | None = None
    methods: tuple[str, ...] | None = None
    steps: tuple[int, ...] | None = None
    view: str = "xz"

    def __post_init__(self) -> None:
        require_choice("view", self.view, VIEWS)
        for name in ("methods", "steps"):
            if getattr(self, name) == ():
                raise ReportError(f"{name} is empty; accepted: at least one, or null")


def sections_of(
    evaluation: Evaluation, sequence: SequenceConfig, baseline: str | None = None
) -> list[Section]:
    """The sections; a picture that cannot be drawn says why. baseline: to compare all with."""
    styles = method_styles(planned_methods(evaluation))
    half = last_half(evaluation.rows)
    chsel_medial = ("chsel", "medial_constraint", "medial_constraint_cma_me")
    sections = [
        Section(
            "there",
            "What was run",
            "A trial is a configuration with a seed. Its steps are the registrations after probes. "
            "What is missing or has failed is nowhere counted as a number.",
            tables=_filled(
                completeness_table(evaluation, styles),
                objects_table(evaluation),
                failures_table(evaluation),
            ),
        ),
        *true_pose_sections(evaluation),
        *sections_on_faults(evaluation, styles),
        *([] if baseline is None else [section_against(evaluation, styles, baseline)]),
        _over_probes(evaluation, styles),
        _boxes(half, styles),
        _times(evaluation, styles),
        _iterations(evaluation, styles),
        _some(
            evaluation,
            _among(styles, chsel_medial),
            "medial",
            "The Medial Constraint with and without quality diversity",
            "What quality-diversity search brings to the objective of the Medial Constraint, "
            "beside CHSEL.",
        ),
        _some(
            evaluation,
            _among(styles, ("icp", "cvo", "cvo_no_free_space")),
            "cvo",
            "CVO with and without free space",
            "What CVO gains or loses by free points, beside ICP, which never uses them.",
        ),
        _gradients(evaluation, sequence),
        _sequence(evaluation, styles, sequence),
    ]
    return sections + _calibration(half, styles, evaluation.definition)


def _over_probes(evaluation: Evaluation, styles: Styles) -> Section:
    picture, missing = _drawn(lambda: picture_over_probes(evaluation, styles, "pd_over_probes.png"))
    text = (
        "Median (line) and 25th to 75th percentile (band) over the trials of an object, all of "
        "its configurations and seeds, at every step. Lower is better. Configurations have more "
        "or fewer probes, so that first and last steps are of some trials only."
    )
    tables = [
        method_table(
            f"PD in mm² of {name} by step",
            "step",
            [row for row in evaluation.rows if row["object"] == name and row["step"] is not None],
            lambda row: row["step"],
            styles,
        )
        for name in evaluation.objects
    ]
    title = "Plausible diversity over the probes"
    return Section("over-probes", title, text, picture, missing, _filled(*tables))


def _boxes(half: Sequence[Row], styles: Styles) -> Section:
    picture, missing = _drawn(lambda: picture_of_boxes(half, styles, "pd_boxes.png"))
    text = (
        f"{_LAST_HALF} Boxes span the 25th to the 75th percentile, white lines are medians; "
        "whiskers reach the least and greatest numbers apart from outliers, which are diamonds "
        "(farther than 1.5 boxes from the box). Lower is better."
    )
    tables = _pd_tables(half, styles)
    title = "Plausible diversity by object and method"
    return Section("boxes", title, text, picture, missing, tables)


def _pd_tables(half: Sequence[Row], styles: Styles) -> tuple[Table, ...]:
    by_object = method_table(
        "PD in mm² by object", "object", half, lambda row: row["object"], styles
    )
    by_configuration = method_table(
        "PD in mm² by configuration",
        "configuration",
        half,
        lambda row: row["configuration"],
        styles,
    )
    return _filled(by_object, by_configuration)


def _times(evaluation: Evaluation, styles: Styles) -> Section:
    rows = evaluation.rows
    picture, missing = _drawn(lambda: picture_of_times(rows, styles, "times.png"))
    text = (
        "Wall-clock time of the registration alone on one thread, after a warm-up, over all "
        "trials and steps: bars are means, lines one standard deviation to either side, as far as "
        "the axis goes. Several workers on one machine slow each other down."
    )
    tables = _filled(table_of_times(rows, styles))
    return Section("times", "Time per registration", text, picture, missing, tables)


def _iterations(evaluation: Evaluation, styles: Styles) -> Section:
    picture, missing = _drawn(
        lambda: picture_over_iterations(evaluation, styles, "over_iterations.png")
    )
    configurations = sorted({row["configuration"] for row in evaluation.iterations})
    text = (
        "What a method would give if its search ended after so many iterations: PD of the "
        "hypotheses, and the mean cost of the best cells, from which these are taken. Medians and "
        "25th to 75th percentiles over trials and steps; all searches of a trial and step start "
        "alike."
    )
    text += f" Of {', '.join(configurations)}." if configurations else ""
    tables = tables_over_iterations(evaluation, styles)
    title = "Plausible diversity and cost over QD iterations"
    return Section("over-iterations", title, text, picture, missing, tables)


def _some(evaluation: Evaluation, styles: Styles, name: str, title: str, text: str) -> Section:
    """PD over the probes of a few methods."""
    text += " Median and 25th to 75th percentile over the trials of an object at every step."
    picture, missing = _drawn(lambda: picture_over_probes(evaluation, styles, f"{name}.png"))
    rows = [row for row in last_half(evaluation.rows) if row["method"] in styles]
    heading = "PD in mm² by object, of these methods"
    table = method_table(heading, "object", rows, lambda row: row["object"], styles)
    table = Table(table.title, table.header, table.rows, note=_LAST_HALF)
    return Section(name, title, text, picture, missing, _filled(table) if styles else ())


def _gradients(evaluation: Evaluation, sequence: SequenceConfig) -> Section:
    text = (
        "Where the negative gradient of the relaxed cost pushes a point, on the X-Z "
        "cross-section of the object (in its own frame) that holds most of it: free points in "
        "red, occupied points in purple, known surface points in black; grey dots are not pushed. "
        "The line is the zero level of the SDF, the broken one the penetration tolerance. Longer "
        "arrows are stronger pushes, to a scale of its own in each panel; free points as in the "
        "sum over free points (Eq. 8)."
    )

    def draw() -> Picture:
        trial, _ = _trial(evaluation, sequence)
        method = next(
            (m for m in ("chsel", *evaluation.methods) if evaluation.recording(trial, m)), None
        )
        path = evaluation.recording(trial, method) if method else None
        if path is None:
            raise NotDrawn(f"there is no recording of {trial[0]}, seed {trial[1]}")
        return picture_of_gradients(path, "gradients.png")

    picture, missing = _drawn(draw)
    return Section("gradients", "Gradients of the cost", text, picture, missing)


def _sequence(evaluation: Evaluation, styles: Styles, sequence: SequenceConfig) -> Section:
    title = "A probing sequence"
    try:
        trial, why = _trial(evaluation, sequence)
    except NotDrawn as reason:
        return Section("sequence", title, "", missing=str(reason))
    asked = sequence.methods or _OF_SEQUENCE
    paths = {m: evaluation.recording(trial, m) for m in asked}
    if sequence.methods is None and not any(paths.values()):
        paths = {m: evaluation.recording(trial, m) for m in styles}
    found = {method: path for method, path in paths.items() if path is not None}
    text = (
        f"Hypotheses as outlines of the mesh, seen {_VIEW_NAMES[sequence.view]}; the true pose is "
        "the broken line, contacts so far are orange, with the gripper's way to them. The trial is "
        f"{trial[0]}, seed {trial[1]}"
    )
    text += f", {why}." if why else "."
    if len(found) < len(paths):
        text += f" Not recorded: {', '.join(m for m in paths if m not in found)}."

    def draw() -> Picture:
        if not found:
            raise NotDrawn(f"there is no recording of {', '.join(asked)} in this trial")
        return picture_of_sequence(
            found, styles, "sequence.png", steps=sequence.steps, view=sequence.view
        )

    picture, missing = _drawn(draw)
    return Section("sequence", title, text, picture, missing)


def _calibration(half: Sequence[Row], styles: Styles, definition: str) -> list[Section]:
    """Where they were computed: the truth's rank, and how many hypotheses are plausible."""
    titles: dict[str, tuple[str, str, Best]] = {
        "rank": (
            "Rank of the true pose among the hypotheses",
            "Uniform in (0, 1], so 0.5 in the median, for a set that spreads as far as it errs; "
            "small ones say that the truth is outside of it.",
            None,
        ),
        "exact_members": (
            "Share of hypotheses in the plausible set",
            f"Of hypotheses that fulfil the definition of the plausible set themselves, "
            f"{definition}; 1 is best.",
            max,
        ),
    }
    tables = []
    for column, (title, note, best) in titles.items():
        if any(row.get(column) is not None for row in half):
            table = method_table(
                title, "object", half, lambda row: row["object"], styles, column=column, best=best
            )
            tables.append(Table(table.title, table.header, table.rows, note=note))
    if not tables:
        return []
    title = "Calibration and membership"
    return [Section("calibration", title, _LAST_HALF, tables=tuple(tables))]


def _trial(evaluation: Evaluation, sequence: SequenceConfig) -> tuple[Trial, str]:
    """The trial to show, and why this one unless it was asked for."""
    if sequence.trial is None:
        return usual_trial(evaluation)
    return named_trial(sequence.trial), ""


def _among(styles: Styles, methods: Sequence[str]) -> Styles:
    return {method: style for method, style in styles.items() if method in methods}


def _filled(*tables: Table) -> tuple[Table, ...]:
    return tuple(table for table in tables if table.rows)


def _drawn(draw: Callable[[], Picture]) -> tuple[Picture | None, str]:
    """A picture, or why there is none."""
    try:
        return draw(), ""
    except NotDrawn as reason:
        return None, str(reason)
