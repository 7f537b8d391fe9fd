"""The relaxed cost of a pose (CHSEL, Eqs. 6 to 10), compiled and differentiable."""
