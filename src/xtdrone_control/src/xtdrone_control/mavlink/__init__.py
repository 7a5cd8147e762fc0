"""The autopilot's MAVLink: UDP links of every vehicle, telemetry streams, commands, set-points, parameters.

``server`` owns the links; ``receiver`` acts on what comes in, ``streams`` sends ``telemetry`` when it is due.
"""
