"""AprilTags: detection, pose, and landing target."""
