"""The aiding sources, one module each, named as in PX4's ekf2."""
