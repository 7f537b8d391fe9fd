"""The arguments of a command as Hydra takes them, which knows KEY=VALUE alone."""

from __future__ import annotations

import os
from collections.abc import Iterable, Iterator

from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.override_parser.types import Quote, QuotedString
from hydra.errors import HydraException

from chsel.errors import SettingError

TRACEBACK = "--traceback"
_FILES = {
    "align": ("file",),
    "judge": ("file",),
    "bop": ("file",),
    "plausible": ("file", "steps"),
    "rank": ("dir",),
    "report": ("dir",),
}
"""Settings that words without a key are, by command; the last takes all that are left."""
_OPEN_GROUPS = {"evaluate": ("settings", "outside", "policy"), "real": ("settings",)}
"""Groups that may have any key, by command; Hydra wants ++ before such a key."""
_TAKES_VALUE = ("-c", "--cfg", "-p", "--package", "-cp", "-cn", "-cd", "-i", "--info")


def hydra_arguments(command: str, words: Iterable[str]) -> list[str]:
    """Return the arguments for Hydra of `python -m runners.COMMAND WORDS`, without `--traceback`.

    Raise SettingError for a word without a key too many.
    """
    words = [word for word in words if word != TRACEBACK]
    sweep = "-m" in words or "--multirun" in words
    kept: list[str] = []
    files: list[str] = []
    rest = iter(words)
    for word in rest:
        if word in _TAKES_VALUE or word.startswith("--config-"):
            kept += [word, *([] if "=" in word else [next(rest, "")])]
        elif word.startswith("-"):
            kept.append(word)
        elif command in _FILES and ("=" not in word or os.path.lexists(word)):
            files.append(word)
        else:
            group = word.partition("=")[0].partition(".")[0]
            mark = "++" if "=" in word and group in _OPEN_GROUPS.get(command, ()) else ""
            kept.append(mark + as_typed(word, sweep=sweep))
    return kept + list(_file_settings(_FILES.get(command, ()), files))


def as_typed(word: str, *, sweep: bool = False) -> str:
    """Return KEY=VALUE with ~ for the home folder, and a value that Hydra cannot read in quotes.

    A path such as a,b [1].obj is not of its grammar; of a sweep, values with commas are several.
    """
    key, sign, value = word.partition("=")
    if not sign:
        return word
    word = f"{key}={os.path.expanduser(value)}"
    try:
        override = OverridesParser.create().parse_override(word)
    except HydraException:
        return f"{key}={quoted(os.path.expanduser(value))}"
    several = override.is_sweep_override() and not sweep
    return f"{key}={quoted(os.path.expanduser(value))}" if several else word


def quoted(text: str) -> str:
    """Return a text as a value that Hydra takes as it is."""
    return QuotedString(text=text, quote=Quote.single).with_quotes()


def _file_settings(names: tuple[str, ...], files: list[str]) -> Iterator[str]:
    """Yield files as the settings that they are."""
    if len(files) > len(names) and names[1:] != ("steps",):
        accepted = f"{names[0].upper()} KEY=VALUE ..."
        raise SettingError(f"{files[1]!r} is one argument too many; accepted: {accepted}")
    for name, path in zip(names[:1], files, strict=False):
        yield f"{name}={quoted(path)}"
    if files[1:]:
        yield f"{names[1]}={quoted(','.join(files[1:]))}"
