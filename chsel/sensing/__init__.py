"""Free space and surface points from cameras, tactile pads and a moving hand."""
