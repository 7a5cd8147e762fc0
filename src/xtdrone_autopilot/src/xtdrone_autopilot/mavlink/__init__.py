"""The autopilot's MAVLink: UDP links of every vehicle, telemetry streams, commands, setpoints, parameters.

``mavlink_server`` owns the links; ``receiver`` routes received messages to the services of ``list_of_services``;
``streams`` schedules telemetry.
"""
