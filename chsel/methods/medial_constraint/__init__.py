"""Medial Constraint."""
