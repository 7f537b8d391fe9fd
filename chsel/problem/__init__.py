"""What a registration is: points, mesh, signed distances, poses, random streams, the problem."""
