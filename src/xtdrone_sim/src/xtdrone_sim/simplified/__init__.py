"""The simplified simulator: first- and second-order vehicles, and the swarm's own Leader and Follower without ROS."""
