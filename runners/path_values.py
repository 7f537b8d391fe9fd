"""Values of settings that are paths, taken as they are typed in a shell.

Hydra reads commas, brackets, quotes, = and ${...} in a value as its own grammar. A path that has
them is handed to it in quotes.
"""

from __future__ import annotations

import os
import re
from collections.abc import Iterable

from hydra.core.override_parser.types import Quote, QuotedString

_PATH_KEYS = (
    r"assets\.dir",
    r"dir",
    r"file",
    r"logs",
    r"object\.path",
    r"out",
    r"outside\.[^=]+",
    r"package\.directory",
    r"package\.python",
    r"pose",
    r"session\.logs",
    r"session\.path",
    r"session\.pose",
    r"session\.rig\.bubbles\.\d+\.reference",
    r"session\.rig\.hand\.urdf",
)
_PATH_SETTING = re.compile(rf"(\+{{0,2}}(?:{'|'.join(_PATH_KEYS)})=)(.+)", re.DOTALL)
_SETTING = re.compile(r"[~+]{0,2}[\w.@/:]+=")
_QUOTED = re.compile(r"'.*'|\".*\"", re.DOTALL)


def literal_paths(words: Iterable[str]) -> list[str]:
    """Arguments of a command with the values of path settings quoted for Hydra, ~ expanded.

    null, and values that are in quotes already, stay as they are; so a sweep over files is
    'session.path="a.npz","b.npz"'.
    """
    return [_literal(word) for word in words]


def quoted(text: str) -> str:
    """A text as a value that Hydra takes literally."""
    no_interpolation = re.sub(r"(\\*)\$\{", r"\1\1\\${", text)
    return QuotedString(text=no_interpolation, quote=Quote.single).with_quotes()


def is_setting(word: str) -> bool:
    """Whether an argument is KEY=VALUE, and not the name of a file that has such a name."""
    return bool(_SETTING.match(word)) and not os.path.lexists(word)


def _literal(word: str) -> str:
    setting = _PATH_SETTING.fullmatch(word)
    if setting is None:
        return word
    key, value = setting.groups()
    if value == "null" or _QUOTED.fullmatch(value):
        return word
    return key + quoted(os.path.expanduser(value))
