"""What `python -m runners.benchmark` measures, and how it reports it."""
