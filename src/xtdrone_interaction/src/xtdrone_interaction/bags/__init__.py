"""ROS bags as files: reading (also damaged ones), decoding of messages, conversion to other formats."""
