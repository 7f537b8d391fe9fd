"""Three sets of settings: `paper` as printed, `reference` as its authors ran it, `default` ours.

`paper` differs from the print in these points, so that its results keep their bits; docs/presets.md
has them all, with the reasons, and every setting in which the presets differ:

- Beyond the SDF grid, where the paper queries the mesh, distances are bounds from the grid's border
  (see SdfGrid.query), so that a problem holds all that determines its result.
- The noise of Algorithm 2 acts on world_from_object, the inverse of the paper's T.
- E_l has the solutions of all cells, as Sec. IV-D says; Algorithm 2 has those of E alone.
- The deviation that sizes the archive is at least `archive.least_deviation`, 0.1 mm.
- ICP draws its surface points anew for every registration, not for every trial.
- CVO searches along its flow for a step that gains, and compares all pairs of points. It anneals
  its length scale in `default` alone.
- Medial Constraint's balls come from exact clearances of free voxels; E_l seeds its CMA-ME, too.

What came to `default` later is off in the classes of the settings, so that recordings made before
it give the same bits.
"""

from __future__ import annotations

from chsel.cost.cost_settings import CostSettings
from chsel.methods.anchored.anchor_sampling import AnchoredStarts
from chsel.methods.gradient_descent import DescentSettings
from chsel.problem.warm_start import OnlineSettings
from chsel.qd.emitters import EmitterSettings
from chsel.qd.selection import ArchiveSettings, OutputSettings

PRESETS = ("default", "paper", "reference")

COST = {
    "default": CostSettings(),
    "paper": CostSettings(lookup="nearest"),
    "reference": CostSettings(
        free_term="interior", occupied_scale=0.0, lookup="nearest", outside="bounding_box"
    ),
}
DESCENT = {
    "default": DescentSettings(),
    "paper": DescentSettings(stop_below=None),
    "reference": DescentSettings(),
}
STARTS = {"default": AnchoredStarts(), "paper": None, "reference": None}
ARCHIVE = {
    "default": ArchiveSettings(measure="object_xy", bins=56),
    "paper": ArchiveSettings(outliers="none", least_deviation=1e-4),
    "reference": ArchiveSettings(least_deviation=1e-4, tolerance_per_point=0.0, tolerance=0.1),
}
EMITTER = {
    "default": EmitterSettings(sigma0=0.005, rate=0.01),
    "paper": EmitterSettings(start="initial"),
    "reference": EmitterSettings(start="initial", ribs_parity=True),
}
OUTPUT = {
    "default": OutputSettings(
        choice="representative",
        ratio=1.3,
        tolerance_per_point=5e-4,
        free_tolerance=0.01,
        margin=0.15,
    ),
    "paper": OutputSettings(limit="none", shortage="fewer"),
    "reference": OutputSettings(limit="ratio", shortage="resample"),
}
ONLINE = {
    "default": OnlineSettings(),
    "paper": OnlineSettings(rotation_law="axis_gauss", keep_best=False),
    "reference": OnlineSettings(initial="upright"),
}
