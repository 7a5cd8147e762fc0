"""Camera video for ground stations: H.264 over RTP, and MAVLink's camera protocol."""
