"""Settings of the mission control."""

from __future__ import annotations

from dataclasses import dataclass

from xtdrone_common.settings import Settings, setting

ON_FIND = ("hold", "return", "continue")


@dataclass(frozen=True)
class MissionSettings(Settings):
    """Settings of the mission control; each is a private ROS parameter of search_mission.py."""

    on_find: str = setting("hold", choices=ON_FIND, text="what the other vehicles do once a person is confirmed")
    gimbal_pitch: float = setting(
        -60.0, low=-90.0, high=-5.0, unit="deg", text="camera pitch while searching, negative down"
    )
    person_pixels: float = setting(
        12.0, low=1.0, high=200.0, unit="px", text="minimum height in the image of a person at a covered place"
    )
    candidate_hits: int = setting(4, low=1, high=100, text="images of one vehicle that make a candidate")
    candidate_probability: float = setting(0.62, low=0.0, high=1.0, text="their minimum mean probability")
    same_place: float = setting(
        6.0, low=0.5, high=50.0, unit="m", text="sightings within this distance of a candidate are merged into it"
    )
    margin: float = setting(
        5.0, low=0.0, high=100.0, unit="m", text="candidates count up to this far outside the region"
    )

    look_height: float = setting(
        9.5, low=3.0, high=50.0, unit="m", text="height of a second look over the ground; at least 1 m below all paths"
    )
    look_step: float = setting(
        0.5, low=0.0, high=5.0, unit="m", text="height difference between the looks of two consecutive vehicles"
    )
    look_pitch: float = setting(
        -50.0, low=-90.0, high=-5.0, unit="deg", text="camera pitch in a look; determines the radius of its circle"
    )
    look_speed: float = setting(3.0, low=0.5, high=10.0, unit="m/s", text="speed of the setpoint in a look")
    look_arc: float = setting(
        60.0, low=0.0, high=360.0, unit="deg", text="minimum arc flown on the circle before a candidate is confirmed"
    )
    look_time: float = setting(
        60.0, low=5.0, high=600.0, unit="s", text="a candidate is rejected after this time without a decision"
    )
    look_apart: float = setting(30.0, low=5.0, high=500.0, unit="m", text="minimum distance between two looks")
    confirm_log_odds: float = setting(8.0, low=1.0, high=100.0, text="sum of the images' log-odds that confirms")
    confirm_hits: int = setting(5, low=1, high=100, text="images that must show the person")
    confirm_probability: float = setting(
        0.55, low=0.0, high=1.0, text="minimum mean probability over all images of the place"
    )
    reject_log_odds: float = setting(-8.0, low=-100.0, high=-1.0, text="sum of the log-odds that rejects")

    follow_time: float = setting(60.0, low=0.0, high=36000.0, unit="s", text="how long the person is followed")
    lose_time: float = setting(
        8.0, low=1.0, high=600.0, unit="s", text="a person out of sight for this time is handed over to another vehicle"
    )

    silent_time: float = setting(
        3.0,
        low=2.0,
        high=60.0,
        unit="s",
        text="a vehicle counts as lost when no message from it is received for this time",
    )
    camera_timeout: float = setting(
        5.0, low=1.0, high=600.0, unit="s", text="a camera without new images for this time has failed"
    )
    start_timeout: float = setting(
        90.0, low=5.0, high=3600.0, unit="s", text="a vehicle not airborne after this time counts as lost"
    )
    return_timeout: float = setting(180.0, low=1.0, high=3600.0, unit="s", text="longest wait for all vehicles to land")
    time_limit: float = setting(1800.0, low=1.0, high=36000.0, unit="s", text="the search ends after this time")
    ground: float = setting(0.0, low=-1000.0, high=10000.0, unit="m", text="height of the ground in the map frame")
