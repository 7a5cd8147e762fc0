"""HTTP and WebSocket server of the station: who may connect, what may be called, what is sent to slow browsers."""
