"""The autopilot's MAVLink: UDP links of every vehicle, telemetry streams, commands, setpoints, parameters.

``server`` owns the links; ``receiver`` routes what comes in to the ``services``, ``streams`` sends ``telemetry`` when
it is due.
"""
