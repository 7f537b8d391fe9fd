"""Quality-diversity search: archive, measures, emitters, selection (CHSEL, Sec. IV-C)."""
