"""What cameras, tactile pads and a moving hand tell of free space and of the surface."""
