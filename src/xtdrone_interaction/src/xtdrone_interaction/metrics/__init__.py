"""Numbers computed from recordings; no drawing, no ROS."""
