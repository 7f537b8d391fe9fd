"""The simulated twin of the paper's cabinet: a robot cell that writes a raw log."""
