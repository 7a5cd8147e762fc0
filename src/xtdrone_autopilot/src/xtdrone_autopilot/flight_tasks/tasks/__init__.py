"""The flight tasks: for AUTO modes, ORBIT, FOLLOW_TARGET and sticks (PX4: flight_mode_manager/tasks)."""
