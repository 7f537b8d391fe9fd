"""What is registered: every method, preset, measure, and form of the cost, at least once."""

from dataclasses import dataclass, field
from functools import partial
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
            descent = {"stop_below": None, "restarts": 10}
            quick = {"descent": descent, "emitter": {"iterations": 100}}
        for changes in (quick, self.changes):
            for name, value in changes.items():
                if name in settings:
                    settings[name] = _changed(settings[name], value)
        return build_method(self.method, settings)


def _changed(value, change):
    both = isinstance(value, dict) and isinstance(change, dict)
    return {**value, **change} if both else change


def _case(method="chsel", preset="default", at="bracket", **given):
    """A case by its fields; of others, changes. at: the place, and the body that is there."""
    fields = {name: given.pop(name) for name in ("classes", "steps", "long") if name in given}
    body = "mallet" if at == "mallet" else "bracket"
    return Case(method, preset, changes=given, body=body, place=at, **fields)


_all = partial(_case, classes=ALL_CLASSES)


def _on_plane(measure, plane, *, method="chsel", **more):
    return _case(method, at="standing", archive={"measure": measure}, plane=plane, **more)


_PRODUCT = {
    f"{method} {preset}": Case(method, preset, steps=2) for method in OURS for preset in PRESETS
}
_COSTS = {
    "exact gradient": _all("gradient_descent", at="mallet", cost={"gradient": "exact"}),
    "exact gradient, nearest, box": _all(
        cost={"gradient": "exact", "lookup": "nearest", "outside": "bounding_box"}
    ),
    "near alpha": _all(cost={"penetration_tolerance": -0.004}),
    "deep alpha": _all(cost={"penetration_tolerance": -0.02}),
    "deep alpha, nearest": _case(
        "gradient_descent", "paper", cost={"penetration_tolerance": -0.018}
    ),
    "interior, trilinear, by volume": _all(
        cost={"free_term": "interior", "volume_normalise": True, "interior_spacing": 0.007}
    ),
    "all classes, dead band": _all(
        at="mallet", cost={"known_tolerance": 0.002}, archive={"outliers": "quantile"}
    ),
    "free points alone": _case(classes=("free",)),
    "contacts alone": _case("chsel_cma_me", classes=("contacts",)),
}
_OTHERS = {
    "SVGD, median": _all("svgd", kernel="median"),
    "ICP without an end": _case("icp", stop_below=None, iterations=60),
    "CVO, balanced": _case("cvo", at="mallet", balanced=True),
    "medial, on a plane": _case("medial_constraint_cma_me", at="standing", plane=OBLIQUE),
    "medial, one start": _case("medial_constraint", cma_es={"starts": "single"}),
    "anchored, all classes": _all("anchored", at="mallet"),
    "anchored on a plane": _case("anchored", at="standing", plane=OBLIQUE),
    "anchored, free points alone": _case("anchored", classes=("free",)),
    "anchored, rounds": _case(
        "anchored", effort={"samples": 500, "kept": 4, "evaluations": 20_000}
    ),
    "anchored, in full": _all("anchored", steps=2, long=True),
}
_SESSIONS = {
    "race": _case(descent={"restarts": 4, "iterations": 10, "race": [1.0, 0.5, 0.2]}),
    "two passes": _case(at="mallet", steps=2, passes=2),
    "two passes of CMA-ME": Case("chsel_cma_me", changes={"passes": 2}, body="mallet"),
    "three steps": _all(
        steps=3,
        online={
            "initial": "contact_centroid",
            "rotation_law": "axis_gauss",
            "low_cost_set": "estimates",
        },
        emitter={"ribs_parity": True},
    ),
    "from the origin": _case(
        "chsel_cma_me", steps=2, online={"initial": "origin"}, emitter={"ribs_parity": True}
    ),
}
_BINS = {"position_3": 8, "object_xy": 20, "object_yaw": 50}
_BINS |= {f"rotation_{k}": bins for k, bins in enumerate((60, 12, 8, 5, 4, 3), 1)}
_MEASURES = {name: _case(archive={"measure": name, "bins": bins}) for name, bins in _BINS.items()}
_PLANES = {
    "plane_position": _on_plane("plane_position", ON_TABLE, steps=2),
    "plane_angle": _on_plane("plane_angle", OBLIQUE),
    "plane, position_2": _on_plane("position_2", OBLIQUE, method="chsel_cma_me"),
    "plane, object_yaw": _on_plane("object_yaw", ON_TABLE, method="chsel_cma_me"),
    "plane, object_xy": _on_plane("object_xy", ON_TABLE),
    "plane, position_3": _case(archive={"measure": "position_3", "bins": 8}, plane=OBLIQUE),
    "plane, descent": _case("gradient_descent", at="standing", plane=OBLIQUE),
}
_LONG = {
    "long CMA-MEGA": _all(steps=2, long=True),
    "long, on a plane": _on_plane("plane_position", ON_TABLE, long=True),
    "long CMA-ME": _case("chsel_cma_me", "reference", at="mallet", long=True),
    "long descent": _case("gradient_descent", "paper", at="mallet", long=True),
}
CASES = {**_PRODUCT, **_COSTS, **_OTHERS, **_SESSIONS, **_MEASURES, **_PLANES, **_LONG}
