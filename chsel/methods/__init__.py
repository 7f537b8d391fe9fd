"""Registration methods: each a file, or a folder with its parts."""

from chsel.methods.registry import (
    METHODS,
    OURS,
    build_method,
    default_method,
    noise_of,
    preset_settings,
    trust_by,
)

__all__ = [
    "METHODS",
    "OURS",
    "build_method",
    "default_method",
    "noise_of",
    "preset_settings",
    "trust_by",
]
