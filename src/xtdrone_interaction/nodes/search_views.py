#!/usr/bin/env python3
"""Films the camera views of a search, with the detector's boxes, and saves the image of the find.

Topics:
    /uav_<i>/darknet_ros/detection_image (sensor_msgs/Image, in): the images with boxes.
    /xtdrone/search/event, /xtdrone/search/progress (std_msgs/String, in): JSON of the mission control.

Parameters:
    /xtdrone/fleet (as ``typhoon_h480:6``): the vehicles.
    ~out: folder for views.mp4, views.png (when something was found, and at the end) and find.png.
    ~film (default true): whether to write a film; else images only.

It is part of the lockstep; the film has two frames per simulated second.
"""

from __future__ import annotations

import json
import sys
from functools import partial
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import rospy
from sensor_msgs.msg import Image
from std_msgs.msg import String

import xtdrone_lockstep as lockstep
from xtdrone_common.fleet import FleetError, parse_fleet
from xtdrone_interaction.missions.search.camera_views import Picture, Views
from xtdrone_interaction.recording.topics import SEARCH_EVENTS_TOPIC, SEARCH_PROGRESS_TOPIC
from xtdrone_swarm.view.film import FilmError, FilmWriter

_RATE = 2.0  # Hz of simulated time, frames of the film
_PLAYED_FASTER = 4.0  # playback speed of the film, relative to the flight


class Recorder:
    """Writes the film and the images."""

    def __init__(self, names: list[str], out: Path, film: bool) -> None:
        """Begin the film.

        Raises:
            FilmError: it cannot be written.
        """
        self._out = out
        self._views = Views(names)
        self._film = FilmWriter(out / "views.mp4", self._views.size, _PLAYED_FASTER * _RATE) if film else None
        self._title = ""
        self._finder = ""
        for number, name in enumerate(names):
            lockstep.Subscriber(f"/uav_{number}/darknet_ros/detection_image", Image, partial(self._on_image, name))
        lockstep.Subscriber(SEARCH_EVENTS_TOPIC, String, self._on_event)
        lockstep.Subscriber(SEARCH_PROGRESS_TOPIC, String, self._on_progress)

    def _on_image(self, name: str, message: Any) -> None:
        picture: Picture = np.frombuffer(message.data, np.uint8).reshape(message.height, message.width, 3)
        self._views.set_image(name, message.header.stamp.to_sec(), picture)
        if name == self._finder:
            self._finder = ""
            self._save("find.png", picture)
            self._save("views.png", self._views.draw(self._title)[..., :3])

    def _on_progress(self, message: Any) -> None:
        progress = json.loads(message.data)
        self._views.set_captions(
            {name: str(state).replace("_", " ") for name, state in progress.get("vehicles", {}).items()}
        )
        self._title = f"{progress['sim_time']:.0f} s   {progress['phase']}   {progress.get('text', '')}"

    def _on_event(self, message: Any) -> None:
        event = json.loads(message.data)
        if event["event"] == "confirmed":
            self._finder = event["vehicle"]

    def _save(self, name: str, picture: Picture) -> None:
        if not cv2.imwrite(str(self._out / name), picture[..., ::-1]):
            rospy.logerr("views: %s cannot be written", self._out / name)

    def turn(self) -> None:
        """Add the next frame to the film."""
        if self._film is not None and self._title:
            self._film.add(self._views.draw(self._title))

    def close(self) -> None:
        """Finish the film; without a find, save the last views."""
        if not (self._out / "views.png").exists() and self._title:
            self._save("views.png", self._views.draw(self._title)[..., :3])
        if self._film is None:
            return
        if self._film.frames:
            self._film.finish()
        else:
            self._film.abandon()


def main() -> int:
    """Film until the flight ends; return the exit status."""
    lockstep.init_node("search_views", rate=_RATE)
    try:
        names = [vehicle.name for vehicle in parse_fleet(str(rospy.get_param("/xtdrone/fleet")))]
        out = Path(rospy.get_param("~out"))
        out.mkdir(parents=True, exist_ok=True)
        recorder = Recorder(names, out, bool(rospy.get_param("~film", True)))
    except KeyError as error:
        rospy.logfatal("views: parameter %s is not set", error)
        return 2
    except (ValueError, OSError, FleetError, FilmError) as error:
        rospy.logfatal("views: %s", error)
        return 2
    lockstep.start()
    try:
        lockstep.spin(recorder.turn)
    except FilmError as error:  # a full disk: the flight continues without a film
        rospy.logerr("views: %s", error)
    finally:
        recorder.close()
    return lockstep.exit_status()


if __name__ == "__main__":
    try:
        sys.exit(main())
    except rospy.ROSInitException as error:
        print(f"views: {error}", file=sys.stderr)
        sys.exit(1)
    except rospy.ROSInterruptException:
        sys.exit(1)
