"""The objects that a session can hide: our own models, real scans, and any mesh."""
