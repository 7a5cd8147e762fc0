"""Messages that command a vehicle: commands, setpoints, sticks, gimbal, external sensors."""
