"""The XTDrone communication layer: one small set of commands for every kind of vehicle, on top of MAVROS.

``setpoint`` and ``core`` hold the logic and know no ROS; ``multirotor`` is the node's class; ``arguments`` reads
command lines of programs that serve one vehicle or many.
"""
