"""`python -m runners.reporting.fault_pictures FOLDER`: method=anchored under faults of sensors."""

from __future__ import annotations

import argparse
import sys
from dataclasses import dataclass, replace
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import trimesh
from matplotlib.axes import Axes
from matplotlib.lines import Line2D

from chsel.errors import ChselError, SettingError, require_choice
from chsel.methods import trust_by
from chsel.methods.anchored.anchored import Anchored
from chsel.methods.anchored.anchored_settings import AnchoredSettings
from chsel.numerics.arrays import BoolArray, FloatArray
from chsel.problem.noise import FOREIGN
from chsel.problem.online_registration import OnlineRegistration
from chsel.problem.outline import signed_distances
from chsel.problem.poses import Poses, apply, inverse
from chsel.problem.registration_problem import Trust
from chsel.problem.sdf_grid import mesh_sdf
from chsel.problem.settings import build_settings
from replay.console import Console, print_error, print_written
from replay.events import Probe
from runners.evaluation.trial_configurations import object_values
from runners.objects.loader import ObjectConfig, load_object
from runners.reporting.figures import FORMATS, Picture, drawing, new_figure, write_picture
from runners.reporting.silhouette import (
    CONTACT,
    TRUE_POSE,
    Frame,
    Silhouettes,
    corners_in,
    point_table,
    pose_table,
)
from runners.sessions import open_session
from runners.sessions.configurations import find_configuration
from runners.sessions.faults import LEVELS, probed_mesh
from runners.sessions.probing_settings import ProbingSettings

_ONE_KIND = ("noise_3mm", "quantised_5mm", "foreign_10", "free_wrong", "camera_5mm", "mesh_2pct")
KINDS = ("clean", *_ONE_KIND, "mixed")
"""A level of each kind of fault, and all of them together."""
_MARGIN = 0.05  # metres around what is in view
_IN_VIEW = (0.05, 0.95)  # quantiles of the hypotheses' corners
_FAR = 0.01  # metres off the object: contacts that are marked
_TICKS, _MOST = (-30, -10, -3, -1, 0, 1, 3, 10, 30), 60  # millimetres; logarithmic beyond 1
_POSES = "#0072b2"
_CONTACT: Any = {**CONTACT, "zorder": 6.0}
_OUTLYING: Any = {**_CONTACT, "color": "#d55e00", "marker": "X", "markersize": 9.0}
_FREE: Any = {**_CONTACT, "color": "#cc79a7", "marker": "s", "markersize": 7.0}


@dataclass(frozen=True, eq=False)
class FaultyCase:
    """What is known after some probes of a session with faults, and what the method makes of it."""

    title: str
    mesh: trimesh.Trimesh  # the one that is registered, metres
    probed: trimesh.Trimesh  # the one that the hand has met
    truth: FloatArray  # (4, 4), world_from_object
    hypotheses: FloatArray  # (B, 4, 4), world_from_object, the best first
    contacts: FloatArray  # (C, 3), metres, world
    off: FloatArray  # (2, C), metres, off the registered surface: at the truth and at the best
    wrong: FloatArray  # (F, 3), metres, world: free points inside of the probed object
    trust: Trust
    held: bool  # whether the true pose lies in the set, see Anchored.holds

    @property
    def outlying(self) -> BoolArray:
        """Which contacts (C,) are far off the object."""
        return np.asarray(np.abs(self.off[0]) > _FAR)

    @property
    def truth_in_set(self) -> str:
        """The same in words."""
        return f"truth {'in' if self.held else 'outside'} the set"


def faulty_case(
    level: str, configuration: str, probe: int, seed: int, settings: AnchoredSettings
) -> FaultyCase:
    """Registers what a kinematic session reports up to a probe, all of it at once.

    Raises SettingError for an unknown level or if there is no contact until then.
    """
    require_choice("level", level, LEVELS)
    place, of_session = find_configuration(configuration), ProbingSettings(faults=LEVELS[level])
    config = build_settings(ObjectConfig, object_values(place.object), "object")
    model = load_object(replace(config, configuration=configuration), Path())
    session = open_session("kinematic", of_session, model, seed)
    sdf, method, truth = model.grid(of_session), Anchored(settings), session.world_from_object
    online = OnlineRegistration(
        sdf,
        session.workspace,
        session.free_resolution,
        method.online,
        seed=seed,
        points=session.initial_points,
    )
    if not 0 <= probe < session.count:
        raise SettingError(f"probe is {probe}; accepted: 0 to {session.count - 1}")
    for event in islice(session.probes(), probe + 1):
        assert isinstance(event, Probe)  # as all events of these sessions are
        online.points.add(event.new_points)
    problem = online.pose(probe)
    contacts, free = problem.points.known, problem.points.free
    if truth is None or len(contacts) == 0:
        raise SettingError(f"probe is {probe}; accepted: one with a contact up to it")
    found, true_pose = method.register(problem), inverse(truth[None])
    trust = trust_by(method, problem, found)
    assert trust is not None
    probed = probed_mesh(model.mesh, LEVELS[level])
    both = Poses.of(np.concatenate([true_pose, found.object_from_world[:1]]))
    return FaultyCase(
        title=f"{level}: {configuration}, {len(contacts)} contacts",
        mesh=model.mesh,
        probed=probed,
        truth=truth,
        hypotheses=inverse(found.object_from_world),
        contacts=contacts,
        off=signed_distances(sdf, both, contacts),
        wrong=free[mesh_sdf(probed, apply(true_pose[0], free))[0] < 0.0],
        trust=trust,
        held=bool(method.holds(problem, found, true_pose)[0]),
    )


def picture_of(case: FaultyCase, name: str) -> Picture:
    """The hypotheses from two sides, and how far contacts are off the surface."""
    figure, trust = new_figure(4.5), case.trust
    panels = figure.subplots(1, 3, width_ratios=(1.0, 1.0, 1.3))
    for panel, view in zip(panels, ("xz", "yz"), strict=False):
        _draw_outlines(panel, case, view)
    _draw_distances(panels[2], case)
    found = f"estimated noise {1e3 * trust.noise:.1f} mm, outliers {100.0 * trust.outliers:.0f} %"
    figure.suptitle(f"{case.title}\n{found}; {trust.verdict}; {case.truth_in_set}")
    looks: dict[str, dict[str, Any]] = {
        f"{len(case.hypotheses)} hypotheses": {"color": _POSES},
        "true outline": {"color": TRUE_POSE, "linestyle": "--"},
        "contact": _CONTACT,
    }
    if case.outlying.any():
        looks[f"contact over {1e3 * _FAR:.0f} mm off the object"] = _OUTLYING
    if len(case.wrong):
        looks["free voxel inside the object"] = _FREE
    handles = [Line2D([], [], label=label, **look) for label, look in looks.items()]
    figure.legend(handles=handles, loc="outside lower center", ncols=len(handles))
    true, best = 1e3 * case.off
    data = [
        pose_table(case.hypotheses, kind="hypothesis"),
        pose_table(case.truth[None], kind="true pose"),
        point_table(case.contacts, kind="contact", off_true_pose_mm=true, off_best_mm=best),
        point_table(case.wrong, kind="free voxel inside the object"),
    ]
    return Picture(name, case.title, figure, pd.concat(data))


def _draw_outlines(panel: Axes, case: FaultyCase, view: str) -> None:
    far, places = case.outlying, corners_in(case.mesh, case.hypotheses)
    true = corners_in(case.mesh, [case.truth])
    shown = [np.quantile(places, _IN_VIEW, axis=0), case.contacts, true]
    frame = Frame.around(view, shown, _MARGIN)
    registered, probed = (Silhouettes(mesh, frame) for mesh in (case.mesh, case.probed))
    for pose in case.hypotheses:
        registered.draw(panel, pose, _POSES, width=0.8, alpha=0.4)
    probed.draw(panel, case.truth, TRUE_POSE, width=2.0, style="dashed")
    parts = (case.wrong, _FREE), (case.contacts[~far], _CONTACT), (case.contacts[far], _OUTLYING)
    for points, look in parts:
        panel.plot(*frame.flat(points).T, **look)
    frame.set_on(panel)


def _draw_distances(panel: Axes, case: FaultyCase) -> None:
    sigma, rows = 1e3 * case.trust.noise, np.arange(len(case.contacts)) + 1
    panel.axvspan(-sigma, sigma, color="#dddddd")
    for side in (-FOREIGN, FOREIGN):
        panel.axvline(side * sigma, color="#888888", linestyle=":")
    true, best = 1e3 * case.off
    panel.plot(true, rows, "o", color="none", markeredgecolor=TRUE_POSE, markersize=10.0)
    panel.plot(best, rows, "o", color=_POSES, markersize=6.0)
    panel.set_xscale("symlog", linthresh=1.0)
    panel.set(xlim=(-_MOST, _MOST), yticks=rows, ylabel="contact")
    panel.set_xticks(_TICKS, [f"{tick}" for tick in _TICKS])
    panel.set_xticks([], minor=True)
    panel.set_xlabel("distance from the surface in mm")
    panel.set_title("rings: true pose, dots: best hypothesis\ngrey: noise, dotted: outliers beyond")


def main() -> int:
    """Write FOLDER/LEVEL.png and LEVEL.csv for each level."""
    parser = argparse.ArgumentParser(prog="runners.reporting.fault_pictures", description=__doc__)
    parser.add_argument("folder", type=Path, help="made if it does not exist")
    parser.add_argument("--levels", nargs="+", default=KINDS, help=f"of {', '.join(LEVELS)}")
    parser.add_argument("--configuration", default="mustard")
    parser.add_argument("--probe", type=int, default=10, help="the last one that counts, from 0")
    parser.add_argument("--seed", type=int, default=2)
    parser.add_argument("--format", choices=FORMATS, default=FORMATS[0])
    given = parser.parse_args()
    try:
        given.folder.mkdir(parents=True, exist_ok=True)
        where = given.configuration, given.probe, given.seed
        for level in given.levels:
            case = faulty_case(level, *where, AnchoredSettings())
            with drawing():
                drawn = picture_of(case, level)
                files = write_picture(drawn, given.folder, given.format, small=True)
            Console().print(f"{level}: {case.trust}; {case.truth_in_set}", soft_wrap=True)
            print_written(*files)
    except (ChselError, OSError) as error:
        print_error(str(error))
        return 2
    return 0


if __name__ == "__main__":
    sys.exit(main())
