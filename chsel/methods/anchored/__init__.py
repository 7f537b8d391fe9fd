"""Contact-anchored search."""
