"""The planner of one vehicle: its states from a goal to hovering there, and the node around them."""
