"""HTTP and WebSocket server of the station: access control, methods, and flow control for slow browsers."""
