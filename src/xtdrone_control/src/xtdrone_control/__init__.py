"""Low-level control as XTDrone means it: communication, drone (flights from scripts), network, vehicle_topics."""

from xtdrone_common.former_names import redirect

redirect(
    __name__,
    {
        "autopilot": "xtdrone_autopilot",
        "autopilot.modes": "xtdrone_common.modes",
        "bounded_file": "xtdrone_common.files",
        "cameras": "xtdrone_common.cameras",
        "clouds": "xtdrone_common.clouds",
        "files": "xtdrone_common.files",
        "fleet": "xtdrone_common.fleet",
        "frames": "xtdrone_common.frames",
        "geodesy": "xtdrone_common.geodesy",
        "kernel_cache": "xtdrone_common.kernel_cache",
        "lockstep": "xtdrone_lockstep",
        "mavlink": "xtdrone_autopilot.mavlink",
        "mavros": "xtdrone_mavros",
        "modes": "xtdrone_common.modes",
        "plans": "xtdrone_autopilot.plans",
        "pose_history": "xtdrone_common.pose_history",
        "pose_matrices": "xtdrone_common.pose_matrices",
        "pose_messages": "xtdrone_common.pose_messages",
        "poses": "xtdrone_common.poses",
        "programs": "xtdrone_common.programs",
        "programs.vehicle_program": "xtdrone_control.vehicle_program",
        "ros_codec": "xtdrone_lockstep.ros_codec",
        "rotation": "xtdrone_common.rotation",
        "rotation_arrays": "xtdrone_common.rotation",
        "rotation_kernels": "xtdrone_common.rotation_kernels",
        "settings": "xtdrone_common.settings",
        "shortened_text": "xtdrone_common.files",
        "tag_boards": "xtdrone_common.tag_boards",
        "whole_file": "xtdrone_common.files",
    },
)
