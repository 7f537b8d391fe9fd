"""What is registered: every method, preset, measure, and form of the cost, at least once."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

from chsel.methods import OURS, build_method, preset_settings
from chsel.problem.settings import PRESETS, settings_mapping

ALL_CLASSES = ("contacts", "free", "felt", "occupied")
ON_TABLE = {"plane_height": 0.3}
OBLIQUE = {"axis": (0.36, 0.48, 0.8), "resting_rotation": (0.3, -0.2, 0.5), "offset": 0.05}


@dataclass(frozen=True)
class Case:
    """A few steps of a session in a scene.

    changes: to the preset's settings, group by group. steps: registrations, each with E_0 and E_l
    from the one before. long: enough iterations for a difference of one bit to grow.
    """

    method: str = "chsel"
    preset: str = "default"
    changes: dict[str, Any] = field(default_factory=dict)
    body: str = "bracket"
    place: str = "bracket"
    classes: tuple[str, ...] = ("contacts", "free")
    steps: int = 1
    long: bool = False

    def build(self):
        """The method with its settings."""
        settings = settings_mapping(preset_settings(self.method, self.preset))
        quick = {"descent": {"restarts": 2, "iterations": 15}}
        quick |= {"emitter": {"iterations": 12}, "online": {"hypotheses": 12}}
        quick |= {"cma_es": {"generations": 25}, "iterations": 20, "max_iterations": 6}
        quick["effort"] = {"samples": 3000, "kept": 24, "refined": 12, "steps": 8, "descents": 8}
        quick["effort"] |= {"descent_moves": 40, "chains": 8, "moves": 60, "polish_moves": 40}
        if self.long:
            quick = {
                "descent": {"stop_below": None, "restarts": 10},
                "emitter": {"iterations": 100},
            }
        for changes in (quick, self.changes):
            for name, value in changes.items():
                if name in settings:
                    settings[name] = _changed(settings[name], value)
        return build_method(self.method, settings)


def _changed(value, change):
    both = isinstance(value, dict) and isinstance(change, dict)
    return {**value, **change} if both else change


def _measured(measure, bins, **more):
    archive = {"measure": measure, "bins": bins}
    return Case(changes={"archive": archive, **more})


def _on_plane(measure, plane, method="chsel", **more):
    changes = {"archive": {"measure": measure}, "plane": plane}
    return Case(method, changes=changes, place="standing", **more)


_PRODUCT = {
    f"{method} {preset}": Case(method, preset, steps=2) for method in OURS for preset in PRESETS
}
_COSTS = {
    "exact gradient": Case(
        "gradient_descent",
        changes={"cost": {"gradient": "exact"}},
        body="mallet",
        place="mallet",
        classes=ALL_CLASSES,
    ),
    "exact gradient, nearest, box": Case(
        changes={"cost": {"gradient": "exact", "lookup": "nearest", "outside": "bounding_box"}},
        classes=ALL_CLASSES,
    ),
    "near alpha": Case(changes={"cost": {"penetration_tolerance": -0.004}}, classes=ALL_CLASSES),
    "deep alpha": Case(changes={"cost": {"penetration_tolerance": -0.02}}, classes=ALL_CLASSES),
    "deep alpha, nearest": Case(
        "gradient_descent", "paper", changes={"cost": {"penetration_tolerance": -0.018}}
    ),
    "interior, trilinear, by volume": Case(
        changes={
            "cost": {"free_term": "interior", "volume_normalise": True, "interior_spacing": 0.007}
        },
        classes=ALL_CLASSES,
    ),
    "all classes, dead band": Case(
        changes={"cost": {"known_tolerance": 0.002}, "archive": {"outliers": "quantile"}},
        body="mallet",
        place="mallet",
        classes=ALL_CLASSES,
    ),
    "free points alone": Case(classes=("free",)),
    "contacts alone": Case("chsel_cma_me", classes=("contacts",)),
}
_BASELINES = {
    "SVGD, median": Case("svgd", changes={"kernel": "median"}, classes=ALL_CLASSES),
    "ICP without an end": Case("icp", changes={"stop_below": None, "iterations": 60}),
    "CVO, balanced": Case("cvo", changes={"balanced": True}, body="mallet", place="mallet"),
    "medial, on a plane": Case(
        "medial_constraint_cma_me", changes={"plane": OBLIQUE}, place="standing"
    ),
    "medial, one start": Case("medial_constraint", changes={"cma_es": {"starts": "single"}}),
}
_ANCHORED = {
    "anchored, all classes": Case("anchored", body="mallet", place="mallet", classes=ALL_CLASSES),
    "anchored on a plane": Case("anchored", changes={"plane": OBLIQUE}, place="standing"),
    "anchored, free points alone": Case("anchored", classes=("free",)),
    "anchored, rounds": Case(
        "anchored", changes={"effort": {"samples": 500, "kept": 4, "evaluations": 20_000}}
    ),
    "anchored, in full": Case("anchored", classes=ALL_CLASSES, steps=2, long=True),
}
_SESSIONS = {
    "race": Case(changes={"descent": {"restarts": 4, "iterations": 10, "race": [1.0, 0.5, 0.2]}}),
    "two passes": Case(changes={"passes": 2}, body="mallet", place="mallet", steps=2),
    "two passes of CMA-ME": Case("chsel_cma_me", changes={"passes": 2}, body="mallet"),
    "three steps": Case(
        changes={
            "online": {
                "initial": "contact_centroid",
                "rotation_law": "axis_gauss",
                "low_cost_set": "estimates",
            },
            "emitter": {"ribs_parity": True},
        },
        classes=ALL_CLASSES,
        steps=3,
    ),
    "from the origin": Case(
        "chsel_cma_me",
        changes={"online": {"initial": "origin"}, "emitter": {"ribs_parity": True}},
        steps=2,
    ),
}
_MEASURES = {
    "position_3": _measured("position_3", 8),
    "object_xy": _measured("object_xy", 20),
    "object_yaw": _measured("object_yaw", 50),
    **{
        f"rotation_{k}": _measured(f"rotation_{k}", (60, 12, 8, 5, 4, 3)[k - 1])
        for k in range(1, 7)
    },
}
_PLANES = {
    "plane_position": _on_plane("plane_position", ON_TABLE, steps=2),
    "plane_angle": _on_plane("plane_angle", OBLIQUE),
    "plane, position_2": _on_plane("position_2", OBLIQUE, "chsel_cma_me"),
    "plane, object_yaw": _on_plane("object_yaw", ON_TABLE, "chsel_cma_me"),
    "plane, object_xy": _on_plane("object_xy", ON_TABLE),
    "plane, position_3": Case(
        changes={"archive": {"measure": "position_3", "bins": 8}, "plane": OBLIQUE}
    ),
    "plane, descent": Case("gradient_descent", changes={"plane": OBLIQUE}, place="standing"),
}
_LONG = {
    "long CMA-MEGA": Case(classes=ALL_CLASSES, steps=2, long=True),
    "long, on a plane": _on_plane("plane_position", ON_TABLE, long=True),
    "long CMA-ME": Case("chsel_cma_me", "reference", body="mallet", place="mallet", long=True),
    "long descent": Case("gradient_descent", "paper", body="mallet", place="mallet", long=True),
}
CASES = {
    **_PRODUCT,
    **_COSTS,
    **_BASELINES,
    **_ANCHORED,
    **_SESSIONS,
    **_MEASURES,
    **_PLANES,
    **_LONG,
}
