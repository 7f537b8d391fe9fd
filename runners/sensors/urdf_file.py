"""A URDF file, read within bounds."""

from __future__ import annotations

import io
from pathlib import Path
from typing import Any
from xml.parsers import expat

from chsel.errors import SettingError

MOST_BYTES = 8 * 2**20  # those of whole humanoids have 0.3 MB
MOST_ELEMENTS = 50_000
_DEEPEST = 32  # level of nested elements; a URDF has 5


def read_robot(path: Path, where: str) -> Any:
    """The file as a Robot of yourdfpy: its links and joints, no mesh read yet.

    where: names the file in messages. Raises SettingError for a file that is no URDF or out of
    bounds, and if the package yourdfpy is missing.
    """
    try:
        from yourdfpy import URDF  # optional: rigs of boxes need none
    except ImportError:
        raise SettingError(
            f"{where} needs the package yourdfpy; install it: pip install chsel-replay[urdf]"
        ) from None
    content = _content(path, where)
    _check_xml(content, where)
    try:
        model = URDF.load(io.BytesIO(content), build_scene_graph=False, load_meshes=False)
    except Exception as error:  # it raises whatever it stumbles over
        reason = " ".join(str(error).split())[:200]
        raise SettingError(
            f"{where} is not a URDF ({type(error).__name__}: {reason}); accepted: a robot of links "
            "and joints with all their attributes"
        ) from None
    return model.robot


def _content(path: Path, where: str) -> bytes:
    if not path.is_file():
        kind = "is a folder" if path.is_dir() else "does not exist"
        raise SettingError(f"{where} {kind}; accepted: a URDF file")
    with path.open("rb") as file:
        content = file.read(MOST_BYTES + 1)
    if len(content) > MOST_BYTES:
        raise SettingError(f"{where} is too large; accepted: at most {MOST_BYTES} bytes")
    return content


def _check_xml(content: bytes, where: str) -> None:
    """Refuse what could make a reader of XML expand, recurse or read other files."""
    parser, depth, count = expat.ParserCreate(), 0, 0

    def start(tag: str, _: dict[str, str]) -> None:
        nonlocal depth, count
        depth, count = depth + 1, count + 1
        if depth > _DEEPEST or count > MOST_ELEMENTS:
            raise SettingError(
                f"{where} has too many elements, or too deep ones; accepted: at most "
                f"{MOST_ELEMENTS}, {_DEEPEST} deep"
            )
        if tag.startswith("xacro:"):
            raise SettingError(f"{where} holds xacro macros; accepted: what the tool xacro makes")

    def end(_: str) -> None:
        nonlocal depth
        depth -= 1

    def doctype(*_: Any) -> None:
        raise SettingError(f"{where} has a DOCTYPE; accepted: URDF without one")

    parser.StartElementHandler, parser.EndElementHandler = start, end
    parser.StartDoctypeDeclHandler = doctype
    try:
        parser.Parse(content, True)
    except (expat.ExpatError, ValueError, LookupError) as error:
        raise SettingError(f"{where} is not XML ({error}); accepted: a URDF file") from None
