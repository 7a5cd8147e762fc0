"""Navigation in the plane, with the topics of move_base: costmap from a 2D lidar or a given map, A*, dynamic window."""
