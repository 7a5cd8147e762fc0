"""The action server of move_base, processed in the turns of the lockstep."""
