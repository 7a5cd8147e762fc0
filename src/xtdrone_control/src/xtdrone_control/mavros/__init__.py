"""The MAVROS layer: MAVLink of many autopilots on one side, MAVROS's topics and services on the other.

``connection`` moves frames (``mavlink.codec`` decodes them), ``uas`` is the hub of one vehicle, ``plugins`` has one
module for each MAVROS plugin and one with the tables of those that pass messages on (``relay``), ``streams`` asks the
autopilot for what has subscribers, ``node`` ties it to ROS.
"""
