"""The method anchored, described in docs/anchored.md."""
