"""The MAVROS layer: MAVLink of many autopilots on one side, MAVROS's topics and services on the other.

``link.autopilot_links`` moves frames, ``uas`` is the hub of one vehicle, ``plugins`` and ``extras`` hold a module for
each MAVROS plugin and tables for those that only relay messages (``relayed_messages``), ``link.stream_requests``
requests the messages that have subscribers, and ``mavros_node`` connects everything to ROS.
"""
