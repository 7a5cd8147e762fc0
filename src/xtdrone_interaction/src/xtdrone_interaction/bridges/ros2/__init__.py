"""A bridge to ROS 2 over DDS by cyclonedds, without an installation of ROS 2: standard messages, /clock."""
