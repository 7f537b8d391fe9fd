"""A decision on where to touch next: actions, belief, first contacts, forecasts."""
