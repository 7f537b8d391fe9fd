"""The figures, tables and page of an evaluation."""
