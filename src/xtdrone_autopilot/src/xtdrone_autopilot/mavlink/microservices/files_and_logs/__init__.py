"""Files of the autopilot: MAVLink FTP, component metadata, download and streaming of flight logs."""
