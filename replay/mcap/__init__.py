"""Recordings as MCAP files: written, read, checked, recovered."""
