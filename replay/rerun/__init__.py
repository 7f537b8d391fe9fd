"""Recordings as Rerun shows them."""
