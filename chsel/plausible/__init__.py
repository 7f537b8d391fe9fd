"""The exact plausible set, and how hypotheses are measured by it (CHSEL, Sec. V)."""
