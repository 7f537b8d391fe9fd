"""YAML files from outside, read within bounds."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import yaml

from chsel.errors import SessionError
from chsel.problem.file_checks import refuse_special_file

_DEEPEST = 16  # level of nested lists and mappings
_LONGEST_REASON = 100  # characters


def read_yaml(path: Path, most_bytes: int) -> dict[Any, Any]:
    """The mapping in a file of at most so many bytes, without aliases, which unfold to any size.

    Raises SessionError, whose text begins after the name of the file.
    """
    refuse_special_file("it", path, SessionError)
    try:
        with path.open("rb") as file:
            data = file.read(most_bytes + 1)
    except OSError as error:
        raise SessionError(f"cannot be read ({error.strerror or error})") from None
    if len(data) > most_bytes:
        raise SessionError(f"too large; accepted: at most {most_bytes} bytes")
    try:
        _check_nesting(data)
        values = yaml.safe_load(data)
    except (yaml.YAMLError, ValueError) as error:
        reason = " ".join(str(error).split())[:_LONGEST_REASON]
        raise SessionError(f"not YAML ({reason})") from None
    if not isinstance(values, dict):
        raise SessionError("no mapping of keys to values")
    return values


def _check_nesting(data: bytes) -> None:
    depth = 0
    for event in yaml.parse(data, Loader=yaml.SafeLoader):
        if isinstance(event, yaml.AliasEvent):
            raise SessionError("an alias (*) in the YAML; accepted: values themselves")
        depth += isinstance(event, yaml.CollectionStartEvent)
        depth -= isinstance(event, yaml.CollectionEndEvent)
        if depth > _DEEPEST:
            raise SessionError(f"nested too deep; accepted: {_DEEPEST} levels")
