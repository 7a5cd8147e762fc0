"""The formation flight: on ROS or in one process, in full or simplified physics."""
