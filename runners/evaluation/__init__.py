"""Evaluations: many sessions, all methods on each, one table."""
