"""The relaxed cost (CHSEL, Eqs. 6 to 10), compiled and in torch."""
