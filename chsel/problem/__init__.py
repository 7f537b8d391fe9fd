"""A registration: points, object, poses, settings, the problem and its result."""
