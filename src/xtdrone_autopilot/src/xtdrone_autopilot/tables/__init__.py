"""PX4 v1.14's tables as CSV: parameters, mission commands, events, logged messages, MAVLink messages and streams."""
