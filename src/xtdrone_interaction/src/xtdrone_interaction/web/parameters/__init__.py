"""Parameters of ROS and of the vehicles."""
