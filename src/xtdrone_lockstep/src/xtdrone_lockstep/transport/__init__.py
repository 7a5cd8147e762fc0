"""rospy's topic connections, with counted messages and with callbacks that run in the node's own thread."""
