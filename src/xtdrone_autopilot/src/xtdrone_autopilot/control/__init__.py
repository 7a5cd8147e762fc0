"""Control cascade, allocation, takeoff and land detection (PX4: mc_pos_control, mc_att_control, ...)."""
