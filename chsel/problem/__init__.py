"""What a registration is: points, object, poses, settings, the problem and its result."""
