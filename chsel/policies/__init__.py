"""Which action to take next: a file for each policy."""
