"""The arguments of a command as Hydra takes them: what is typed is changed here, and nowhere else.

Hydra takes KEY=VALUE alone, and reads commas, brackets, quotes, = and ${...} in a value as its own
grammar. So that paths can be typed as for any other program, values of settings that are paths are
handed to it in quotes, and words without a key get one.
"""

from __future__ import annotations

import os
import re
from collections.abc import Iterable
from itertools import islice

from hydra.core.override_parser.types import Quote, QuotedString

from chsel.errors import SettingError

TRACEBACK = "--traceback"
_FILES = {"align": "file", "plausible": "file", "report": "dir"}
"""Of a command: the setting that its first word without a key is."""
_MORE = {"plausible": "steps"}
"""Of a command: the setting that further such words are together; also --SETTING VALUE."""
_OPEN_GROUPS = {
    command: tuple(name + sign for name in names for sign in ".=")
    for command, names in {
        "evaluate": ("settings", "outside", "policy"),
        "real": ("settings",),
    }.items()
}
"""Of a command: groups that may have any key, which Hydra wants to have ++ before it."""
_TAKES_VALUE = ("-c", "--cfg", "-p", "--package", "-cp", "-cn", "-cd", "-i", "--info")
_PATH_KEYS = (
    r"assets\.dir",
    r"data",
    r"dir",
    r"file",
    r"logs",
    r"object\.path",
    r"out",
    r"outside\.[^=]+",
    r"package\.directory",
    r"package\.python",
    r"pose",
    r"session\.hand\.urdf",
    r"session\.logs",
    r"session\.path",
    r"session\.pose",
    r"session\.rig\.bubbles\.\d+\.reference",
    r"session\.rig\.hand\.urdf",
)
_PATH_SETTING = re.compile(rf"(\+{{0,2}}(?:{'|'.join(_PATH_KEYS)})=)(.+)", re.DOTALL)
_SETTING = re.compile(r"[~+]{0,2}[\w.@/:]+=")
_QUOTED = re.compile(r"'.*'|\".*\"", re.DOTALL)


def hydra_arguments(command: str, words: Iterable[str]) -> list[str]:
    """The arguments for Hydra of `python -m runners.COMMAND WORDS`, without `--traceback`.

    Of path settings, null and values that are in quotes already stay as they are; so a sweep over
    files is 'session.path="a.npz","b.npz"'. Raises SettingError for a word without a key too many.
    """
    file, more = _FILES.get(command), _MORE.get(command)
    kept: list[str] = []
    files: list[str] = []
    further: list[str] = []
    rest = iter(words)
    for word in rest:
        if word == TRACEBACK:
            continue
        if word in _TAKES_VALUE or word.startswith("--config-"):
            kept += [word, *([] if "=" in word else islice(rest, 1))]
        elif more and word.split("=")[0] == f"--{more}":
            further.append(word.partition("=")[2] if "=" in word else next(rest, ""))
        elif file is None or word.startswith("-") or is_setting(word):
            mark = "++" if word.startswith(_OPEN_GROUPS.get(command, ())) else ""
            kept.append(mark + _literal(word))
        else:
            (further if files else files).append(word)
    if further and not more:
        accepted = f"{(file or '').upper()} KEY=VALUE ..."
        raise SettingError(f"{further[0]!r} is one argument too many; accepted: {accepted}")
    kept += [f"{file}={quoted(path)}" for path in files]
    return [*kept, f"{more}={quoted(','.join(further))}"] if further else kept


def quoted(text: str) -> str:
    """A text as a value that Hydra takes literally."""
    no_interpolation = re.sub(r"(\\*)\$\{", r"\1\1\\${", text)
    return QuotedString(text=no_interpolation, quote=Quote.single).with_quotes()


def is_setting(word: str) -> bool:
    """Whether an argument is KEY=VALUE, and not the name of a file that has such a name."""
    return bool(_SETTING.match(word)) and not os.path.lexists(word)


def _literal(word: str) -> str:
    """A setting with its value in quotes if it is a path, ~ expanded."""
    setting = _PATH_SETTING.fullmatch(word)
    if setting is None:
        return word
    key, value = setting.groups()
    if value == "null" or _QUOTED.fullmatch(value):
        return word
    return key + quoted(os.path.expanduser(value))
