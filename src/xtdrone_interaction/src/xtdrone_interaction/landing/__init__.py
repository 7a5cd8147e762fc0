"""The landing of a UAV on a ground robot with AprilTags: its director and the figures of its report."""
