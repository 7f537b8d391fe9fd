"""The exact plausible set (CHSEL, Sec. III and V), and measures of results."""
