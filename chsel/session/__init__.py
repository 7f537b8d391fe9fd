"""Algorithm 2 for robots' programs, runs, evaluations and replays: the loop, recorded."""
