"""Measures of how good hypotheses are."""
