"""Goals of the AUTO modes: missions, return, geofence, precision landing, payload (PX4: navigator)."""
