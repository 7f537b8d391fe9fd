"""`python -m docs.pictures.faults FOLDER LEVEL ...`: hypotheses of anchored under faults."""

from __future__ import annotations

import sys
from dataclasses import replace
from itertools import islice
from pathlib import Path

import numpy as np

from chsel.methods import trust_by
from chsel.methods.anchored.anchored import Anchored, AnchoredSettings
from chsel.problem.noise import FOREIGN
from chsel.problem.online_registration import OnlineRegistration
from chsel.problem.outline import signed_distances
from chsel.problem.poses import Poses, apply, inverse
from chsel.problem.sdf_grid import mesh_sdf
from chsel.problem.settings import build_settings
from docs.pictures.outlines import (
    CONTACT,
    POSES,
    TRUE_POSE,
    Frame,
    Outlines,
    corners_in,
    save_figure,
)
from replay.events import Probe
from runners.evaluation.trial_configurations import object_values
from runners.objects.loader import ObjectConfig, load_object
from runners.reporting.figures import drawing, new_figure
from runners.sessions import open_session
from runners.sessions.configurations import find_configuration
from runners.sessions.faults import LEVELS, probed_mesh
from runners.sessions.probing_settings import ProbingSettings

_CONFIGURATION, _PROBE, _SEED = "mustard", 10, 2
_FAR = 0.01  # metres off the object: contacts that are marked
_TICKS, _MOST = (-30, -10, -3, -1, 0, 1, 3, 10, 30), 60  # millimetres; logarithmic beyond 1


def draw(level: str, path: Path) -> str:
    """All points up to one probe, registered at once; returns a line on how far to trust it."""
    place, settings = find_configuration(_CONFIGURATION), ProbingSettings(faults=LEVELS[level])
    config = build_settings(ObjectConfig, object_values(place.object), "object")
    model = load_object(replace(config, configuration=_CONFIGURATION), Path())
    session = open_session("kinematic", settings, model, _SEED)
    sdf, method, truth = (
        model.grid(settings),
        Anchored(AnchoredSettings()),
        session.world_from_object,
    )
    online = OnlineRegistration(
        sdf,
        session.workspace,
        session.free_resolution,
        method.online,
        seed=_SEED,
        points=session.initial_points,
    )
    for event in islice(session.probes(), _PROBE + 1):
        assert isinstance(event, Probe)
        online.points = online.points.merged(event.new_points)
    problem = online.pose(_PROBE)
    found, true_pose = method.register(problem), inverse(truth[None])
    trust = trust_by(method, problem, found)
    held = "in" if method.holds(problem, found, true_pose)[0] else "outside"
    contacts, free = problem.points.known, problem.points.free
    both = Poses.of(np.concatenate([true_pose, found.object_from_world[:1]]))
    off = 1e3 * signed_distances(sdf, both, contacts)  # (2, C), mm, at the truth and at the best
    far, probed = np.abs(off[0]) > 1e3 * _FAR, probed_mesh(model.mesh, LEVELS[level])
    wrong = free[mesh_sdf(probed, apply(true_pose[0], free))[0] < 0.0]
    poses = inverse(found.object_from_world)

    figure = new_figure(4.5)
    panels = figure.subplots(1, 3, width_ratios=(1.0, 1.0, 1.3))
    corners = np.quantile(corners_in(model.mesh, poses), [0.05, 0.95], axis=0)
    outlying = CONTACT | {"color": "#d55e00", "marker": "X", "markersize": 9.0}
    for panel, view in zip(panels[:2], ("xz", "yz"), strict=True):
        shown = [corners, contacts, corners_in(model.mesh, [truth])]
        frame = Frame.around(view, shown, 0.05)
        outlines = Outlines(model.mesh, frame)
        for pose in poses:
            outlines.draw(panel, pose, POSES, linewidths=0.8, alpha=0.4)
        Outlines(probed, frame).draw(panel, truth, TRUE_POSE, linewidths=2.0, linestyles="dashed")
        panel.plot([], [], color=POSES, label=f"{len(poses)} hypotheses")
        panel.plot([], [], color=TRUE_POSE, linestyle="--", label="true outline")
        panel.plot(*frame.flat(contacts[~far]).T, **CONTACT, label="contact")
        if far.any():
            label = f"contact over {1e3 * _FAR:.0f} mm off the object"
            panel.plot(*frame.flat(contacts[far]).T, **outlying, label=label)
        if len(wrong):
            look = CONTACT | {"color": "#cc79a7", "marker": "s", "markersize": 7.0}
            panel.plot(*frame.flat(wrong).T, **look, label="free voxel inside the object")
        frame.set_on(panel)
    handles, labels = panels[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=len(labels))

    panel, sigma, rows = panels[2], 1e3 * trust.noise, np.arange(len(contacts)) + 1
    panel.axvspan(-sigma, sigma, color="#dddddd")
    for side in (-FOREIGN, FOREIGN):
        panel.axvline(side * sigma, color="#888888", linestyle=":")
    panel.plot(off[0], rows, "o", color="none", markeredgecolor=TRUE_POSE, markersize=10.0)
    panel.plot(off[1], rows, "o", color=POSES, markersize=6.0)
    panel.set_xscale("symlog", linthresh=1.0)
    panel.set(xlim=(-_MOST, _MOST), yticks=rows, ylabel="contact")
    panel.set_xticks(_TICKS, [f"{tick}" for tick in _TICKS])
    panel.set_xticks([], minor=True)
    panel.set_xlabel("distance from the surface in mm")
    panel.set_title("rings: true pose, dots: best hypothesis\ngrey: noise, dotted: outliers beyond")
    noise = f"estimated noise {sigma:.1f} mm, outliers {100.0 * trust.outliers:.0f} %"
    title = f"{level}: {_CONFIGURATION}, {len(contacts)} contacts"
    figure.suptitle(f"{title}\n{noise}; {trust.verdict}; truth {held} the set")
    save_figure(figure, path)
    return f"{level}: {trust}; truth {held} the set"


def main(folder: str, *levels: str) -> None:
    """Write FOLDER/LEVEL.png for each level."""
    for level in levels:
        with drawing():
            print(draw(level, Path(folder) / f"{level}.png"))


if __name__ == "__main__":
    main(*sys.argv[1:])
