"""Methods on the same problems, and recordings side by side."""
