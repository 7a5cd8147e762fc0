"""The landing of a UAV on a ground robot with AprilTags."""
