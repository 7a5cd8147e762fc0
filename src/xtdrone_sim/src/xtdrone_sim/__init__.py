"""The simulator: physics, vehicles, sensors, cameras, rays, robots, Gazebo's services, and its node (runtime)."""

from xtdrone_common.former_names import redirect

redirect(
    __name__,
    {
        "data_files": "xtdrone_worlds.data_files",
        "descriptions": "xtdrone_worlds.descriptions",
        "shapes": "xtdrone_worlds.shapes",
        "vehicles.urdf": "xtdrone_worlds.worlds.urdf",
        "worlds": "xtdrone_worlds.worlds",
    },
)
