"""Health of the vehicle and the checks before arming (PX4: commander/HealthAndArmingChecks)."""
