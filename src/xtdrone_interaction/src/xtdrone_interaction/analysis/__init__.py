"""What flights leave behind, bags and ULogs, read and drawn without ROS. No module here imports rospy."""
