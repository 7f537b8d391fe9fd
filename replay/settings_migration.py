"""What recordings leave out of the settings of their method, and what they mean by it.

A recording holds all settings that there were when it was made. Those that came later have the
value here, with which the library does what it did then; today's default may be another one. Those
of `anchored`, CMA-ES and CVO that no longer exist are dropped: its energy, the ends of its runs and
its kernel changed, and so did every result.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import is_dataclass
from typing import Any

from chsel.methods.anchored.anchored_settings import AnchoredSettings
from chsel.methods.chsel import ChselSettings
from chsel.methods.cvo import CvoSettings
from chsel.methods.gradient_descent import DescentSettings
from chsel.methods.medial_constraint import CmaEsSettings
from chsel.problem.online_registration import OnlineSettings
from chsel.qd.selection import OutputSettings

LEFT_OUT: Mapping[type, Mapping[str, Any]] = {
    OnlineSettings: {"update": "noise"},
    OutputSettings: {"choice": "lowest", "margin": None},
    ChselSettings: {"starts": None},
    DescentSettings: {"race": None},
    # The search changed with these; recordings without them were accepted anew at these values.
    AnchoredSettings: {"shared_error": 0.004, "limit": 9.0},
}
_LIMIT = {"limit_noise", "limit_ratio", "limit_slack", "outer_share", "outer_noise"}
DROPPED = {
    AnchoredSettings: {"penetration_tolerance", *_LIMIT},
    CmaEsSettings: {"tolfunhist", "tolx"},
    CvoSettings: {"sigma", "s_sigma", "sp_thres"},
}


def completed(recorded: Mapping[str, Any], default: Any) -> dict[str, Any]:
    """A recorded mapping of today's settings with what it leaves out, groups in it included.

    default: settings of the same class, which show the classes of the groups.
    """
    groups = {
        name: completed(value, getattr(default, name))
        for name, value in recorded.items()
        if isinstance(value, Mapping) and is_dataclass(getattr(default, name, None))
    }
    dropped = DROPPED.get(type(default), set())
    kept = {name: value for name, value in recorded.items() if name not in dropped}
    return {**LEFT_OUT.get(type(default), {}), **kept, **groups}
