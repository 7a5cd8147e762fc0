"""AprilTags: detection, pose, and the landing target that they mark."""
