"""The arithmetic that keeps the bits."""
