"""A simulation of the paper's cabinet: a robot cell that writes a log."""
