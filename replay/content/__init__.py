"""What a recording holds: at a glance, and as arrays and tables for other programs."""
