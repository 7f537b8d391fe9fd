"""The bit contract: compiled loops, arithmetic and geometry with the same bits everywhere."""
