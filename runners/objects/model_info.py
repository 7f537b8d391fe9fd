"""The symmetries of an object that a file declares, as models_info.json of BOP datasets."""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import Any

from chsel.errors import PoseError, SettingError
from chsel.plausible.bop_errors import model_symmetries
from chsel.problem.object_symmetry import ObjectSymmetry

_KEYS = ("symmetries_discrete", "symmetries_continuous")


def read_symmetry(path: Path, *, mesh: str, scale: float) -> ObjectSymmetry:
    """Return the symmetries that a JSON file declares for a mesh.

    The file is the entry of one object, or models_info.json, from which the number in the name of
    the mesh's file chooses, such as 5 of obj_000005.ply. scale: metres in the unit of the file.
    Raise SettingError, which names the file.
    """
    accepted = "accepted: none, or a JSON file as models_info.json of a BOP dataset"
    try:
        values = json.loads(path.read_bytes())
        entry = values if _is_entry(values) else _chosen(values, mesh)
        turns, axes = model_symmetries(entry, scale=scale)
        return ObjectSymmetry.declared(turns=turns, axes=axes)
    except OSError as error:
        reason = error.strerror or str(error)
    except (ValueError, SettingError, PoseError) as error:
        reason = str(error)
    raise SettingError(f"symmetry {path}: {reason}; {accepted}")


def _is_entry(values: Any) -> bool:
    """Return whether the values of a file are of one object."""
    return isinstance(values, dict) and any(key in values for key in _KEYS)


def _chosen(values: Any, mesh: str) -> Any:
    """Return the entry of a mesh in models_info.json. Raise SettingError if there is none."""
    found = re.search(r"(\d+)\.\w+$", mesh)
    number = str(int(found[1])) if found else ""
    if not isinstance(values, dict) or number not in values:
        objects = ", ".join(values) if isinstance(values, dict) else "none"
        raise SettingError(
            f"it has no {_KEYS[0]}, and of the objects {objects[:100]} none is that of the mesh "
            f"{Path(mesh).name}, by the number in its name"
        )
    return values[number]
