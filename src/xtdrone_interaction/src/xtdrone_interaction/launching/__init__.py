"""Run launch files: their own ROS master, their processes, and a clean end."""
