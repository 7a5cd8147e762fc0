"""The autopilot's MAVLink: UDP links of every vehicle, telemetry streams, commands, setpoints, parameters.

``server`` owns the links; ``receiver`` routes received messages to the ``services``; ``streams`` schedules
``telemetry``.
"""
