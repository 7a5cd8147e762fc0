"""Files with missions, geofences and rally points: QGroundControl's .plan and waypoint files."""
