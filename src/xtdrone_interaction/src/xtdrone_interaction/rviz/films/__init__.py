"""``./xtdrone record-view``: films of flights in rviz, without a screen."""
