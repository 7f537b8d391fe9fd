"""One line about what is wrong with the arguments of a command, and what is accepted."""

from __future__ import annotations

import difflib

from hydra.errors import HydraException, MissingConfigException, OverrideParseException
from omegaconf.errors import ConfigAttributeError, ConfigKeyError, OmegaConfBaseException


def error_message(error: BaseException, config_name: str) -> str:
    """One line: what was wrong, and what is accepted."""
    cause = error.__cause__ if isinstance(error, HydraException) else None
    if isinstance(error, MissingConfigException) and error.options and error.missing_cfg_file:
        group, _, choice = error.missing_cfg_file.rpartition("/")
        return _not_accepted(group, f"has no option {choice!r}", choice, list(error.options))
    if isinstance(error, OverrideParseException):
        what = error.message.splitlines()[0]
        return f"{error.override!r} is not a setting ({what}); accepted: KEY=VALUE"
    if isinstance(cause, ConfigKeyError | ConfigAttributeError):
        return _unknown_key(cause, config_name)
    lines = str(error).splitlines() or [type(error).__name__]
    if isinstance(error, OmegaConfBaseException | HydraException):
        lines = lines[:1]  # the others name types of OmegaConf, folders, and what may not help
    text = " ".join(" ".join(lines).split())
    if "No match in the defaults list" in text:
        return f"{text} --help shows what is accepted"
    if isinstance(cause, OmegaConfBaseException):
        text = f"{text}: {error_message(cause, config_name)}"
    return text


def _unknown_key(error: ConfigKeyError | ConfigAttributeError, config_name: str) -> str:
    """Where the path of an override leaves the configuration, and what stands there."""
    key = str(error.full_key).replace("[", ".").replace("]", "")
    where, _, name = key.rpartition(".")
    if any(part.isdecimal() for part in where.split(".")):  # an entry of a list lacks defaults
        return f"{where} does not give {name!r}; accepted: +{key}=VALUE to add it"
    node = error.parent_node or {}
    where = f"{where}={node['name']}" if where == "method" else where
    accepted = [str(known) for known in node if known != "hydra"]
    return _not_accepted(where or config_name, f"has no key {name!r}", name, accepted)


def _not_accepted(where: str, what: str, value: str, accepted: list[str]) -> str:
    close = difflib.get_close_matches(value, accepted, n=1, cutoff=0.5)
    hint = f"; did you mean {close[0]}?" if close else ";"
    return f"{where} {what}{hint} accepted: {', '.join(accepted) or 'no key below it'}"
