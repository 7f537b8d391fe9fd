"""Quality diversity: archive, measures, emitters, selection (CHSEL, Sec. IV-C)."""
