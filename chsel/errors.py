"""Every error that a caller of the library can cause."""

from __future__ import annotations

from collections.abc import Iterable

_LONGEST_VALUE = 80


class ChselError(Exception):
    """Base of all errors whose message is for the user: what, where, what is accepted."""


class SettingError(ChselError):
    """A setting has a value that is not accepted, or a name that does not exist."""


class PointsError(ChselError):
    """Known points are malformed: wrong shape, not finite, or empty where some are needed."""


class MeshError(ChselError):
    """A mesh cannot be found, read or used."""


class SdfError(ChselError):
    """A signed distance grid is malformed."""


class PoseError(ChselError):
    """A pose is not a rigid transform."""


class EvaluationError(ChselError):
    """A plausible set cannot be made, written or read, or does not belong to a problem."""


class EngineError(ChselError):
    """The compiled kernels cannot run here, or a device does not exist."""


class SessionError(ChselError):
    """A probe session cannot be opened or continued."""


class RecordingError(ChselError):
    """A recording cannot be read or written."""


class InputWarning(UserWarning):
    """The input can be registered, but is probably a mistake."""

    def __init__(self, code: str, text: str) -> None:
        super().__init__(code, text)
        self.code = code  # kind of warning, for programs
        self.text = text  # one line, with numbers and what to do

    def __str__(self) -> str:
        return self.text


class PointsWarning(InputWarning):
    """Known points are probably not those of the object, or no hypothesis explains them."""


class MeshWarning(InputWarning):
    """A mesh, or the size of an object, is probably a mistake."""


def quoted(value: object) -> str:
    """A value as errors quote it: on one line, of bounded length; the type of a long value."""
    text = " ".join(repr(value).split())
    return text if len(text) <= _LONGEST_VALUE else f"a {type(value).__name__}"


def require_choice(name: str, value: object, *, accepted: Iterable[str]) -> None:
    """Raise SettingError unless `value` is one of the accepted names."""
    accepted = list(accepted)
    if not isinstance(value, str) or value not in accepted:
        raise SettingError(f"{name} is {quoted(value)}; accepted: {', '.join(accepted)}")


def require_at_most(name: str, value: float, *, most: float) -> None:
    """Raise SettingError if `value` is above a limit."""
    if value > most:
        raise SettingError(f"{name} is {value!r}; accepted: at most {most:_}")


def require_between(name: str, value: float, *, low: float, high: float) -> None:
    """Raise SettingError unless `value` is a length from `low` to `high`, metres."""
    if not low <= value <= high:
        raise SettingError(f"{name} is {value}; accepted: {low:g} to {high:g} (m)")


def require_metres(name: str, value: float, *, most: float, diameter: float) -> None:
    """Raise SettingError if a length is above the most that an object of some diameter allows."""
    if value > most:
        raise SettingError(
            f"{name} is {value:g} m, and the object is {diameter:.3g} m: in millimetres? accepted: "
            f"at most {most:.3g} (m)"
        )


def require_positive(name: str, value: float, *, zero: bool = False) -> None:
    """Raise SettingError unless `value` is a finite number above zero (or at zero, if `zero`)."""
    finite = isinstance(value, int | float) and value == value and abs(value) != float("inf")
    if not finite or value < 0 or (value == 0 and not zero):
        bound = "of at least 0" if zero else "above 0"
        raise SettingError(f"{name} is {quoted(value)}; accepted: a finite number {bound}")


def require_instance(name: str, value: object, *, kind: type, accepted: str) -> None:
    """Raise SettingError unless `value` is an instance of `kind`."""
    if not isinstance(value, kind):
        raise SettingError(f"{name} is {quoted(value)}; accepted: {accepted}")
