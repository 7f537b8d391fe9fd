"""The package that reads URDF files, imported where a rig names one."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from chsel.errors import SettingError
from chsel.numerics.arrays import refuse_special_file


def urdf_class(path: Path, where: str) -> Any:
    """Return the class `yourdfpy.URDF`, to read a file; where: what it is, in errors.

    Raise SettingError if the file does not exist, or the package is not installed.
    """
    if not path.is_file():
        raise SettingError(f"{where} does not exist; accepted: a URDF file")
    try:
        from yourdfpy import URDF  # optional: rigs of boxes need none
    except ImportError:
        raise SettingError(
            f"{where} needs the package yourdfpy; install it where the project is: "
            "pip install -e '.[sensors]'"
        ) from None
    refuse_special_file(where, path, error=SettingError)
    return URDF
