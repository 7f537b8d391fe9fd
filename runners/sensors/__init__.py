"""Recorded robot sessions: raw sensor logs, and how known points follow from them."""
