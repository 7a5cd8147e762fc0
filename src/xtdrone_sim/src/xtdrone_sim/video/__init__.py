"""Cameras as a ground station sees them: H.264 over RTP, and MAVLink's camera protocol."""
