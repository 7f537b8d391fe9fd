"""Medial Constraint."""

from chsel.methods.medial_constraint.medial_constraint import (
    MedialConstraint,
    MedialConstraintCmaMe,
    MedialConstraintCmaMeSettings,
    MedialConstraintSettings,
)

__all__ = [
    "MedialConstraint",
    "MedialConstraintCmaMe",
    "MedialConstraintCmaMeSettings",
    "MedialConstraintSettings",
]
