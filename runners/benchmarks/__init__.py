"""Measurements of `python -m runners.benchmark`, and their report."""
