"""ROS bags as files: reading what is left of damaged ones, decoding messages, converting to other formats."""
