"""XTDrone communication layer on top of MAVROS: one small set of commands for all kinds of vehicles.

``setpoint`` and ``core`` hold the logic, independent of ROS; ``multirotor`` is the class of the node; ``arguments``
parses the command lines of programs that serve one or more vehicles.
"""
