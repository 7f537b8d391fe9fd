"""What a registration is: points, mesh, distances, poses, random streams, the problem."""
