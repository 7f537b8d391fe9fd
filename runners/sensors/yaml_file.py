"""YAML files from outside."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import yaml

from chsel.errors import SessionError
from chsel.problem.file_checks import refuse_special_file


def read_yaml(path: Path) -> dict[Any, Any]:
    """The mapping in a file. Raises SessionError, whose text begins after the name of the file."""
    refuse_special_file("it", path, SessionError)
    try:
        values = yaml.safe_load(path.read_bytes())
    except OSError as error:
        raise SessionError(f"cannot be read ({error.strerror or error})") from None
    except (yaml.YAMLError, ValueError, RecursionError) as error:
        raise SessionError(f"not YAML ({' '.join(str(error).split())[:100]})") from None
    if not isinstance(values, dict):
        raise SessionError("no mapping of keys to values")
    return values
