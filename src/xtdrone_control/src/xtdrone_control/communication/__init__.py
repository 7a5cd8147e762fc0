"""XTDrone's communication layer on top of MAVROS: one small set of commands for all kinds of vehicles.

``commands`` (``MultirotorCore``) and ``setpoint`` hold the logic, independent of ROS; ``multirotor`` has the classes of
the node: a vehicle's topics, services and link to MAVROS.
"""
