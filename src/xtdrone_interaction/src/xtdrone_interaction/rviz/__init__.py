"""Views of flights in rviz: markers, view configurations, windows and films."""
