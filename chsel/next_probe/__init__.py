"""Where to touch next: a decision, what it forecasts, and the policies that make it."""
