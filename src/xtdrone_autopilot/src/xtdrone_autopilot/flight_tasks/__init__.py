"""From the goal of a flight mode to the trajectory setpoint (PX4: flight_mode_manager)."""
