"""Arming, flight modes, failsafes and manual control (PX4: commander)."""
