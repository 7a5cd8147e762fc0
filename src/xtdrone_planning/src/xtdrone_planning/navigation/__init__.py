"""Navigation on a level, with the topics of move_base: a costmap from a 2D lidar or a given map, A*, dynamic window."""
