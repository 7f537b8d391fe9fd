"""Files of robots' logs: MCAP of any program, and bags of ROS."""
