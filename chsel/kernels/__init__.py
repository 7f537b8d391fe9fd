"""The compiled inner loops: IEEE + - * / and sqrt in a fixed order, the same bits on every CPU."""
