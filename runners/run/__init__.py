"""A run of a session: what is registered, recorded and shown of it."""
