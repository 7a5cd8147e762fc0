"""``./xtdrone record PROFILE``: rosbag record with the topics, compression and splitting of a profile.

Exit status: that of rosbag; 1 without a ROS master; 2 for an invalid value.
"""

from __future__ import annotations

import argparse
import os
import re
import shutil
import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from xtdrone_common.files import ContentError, load_yaml, read_text
from xtdrone_interaction import command_options, simulation_services
from xtdrone_interaction.command_options import OptionError

PROFILES = Path("src") / "xtdrone_interaction" / "config" / "record_profiles"
_PACKINGS = {"none": [], "lz4": ["--lz4"], "bz2": ["--bz2"]}
_KEYS = frozenset({"topics", "exclude", "compression", "split", "buffer"})
_MOST = 1 << 20  # MB


@dataclass(frozen=True)
class Profile:
    """Recording settings.

    Attributes:
        topics: regular expressions; a topic is recorded if one matches its whole name.
        exclude: regular expressions of topics that are not recorded.
        compression: ``none``, ``lz4`` or ``bz2``.
        split: maximum size of a file, MB.
        buffer: size of the queue of messages to be written, MB.
    """

    topics: tuple[str, ...]
    exclude: tuple[str, ...]
    compression: str
    split: int
    buffer: int

    def includes(self, topic: str) -> bool:
        """Return whether a topic is recorded."""
        return any(re.fullmatch(p, topic) for p in self.topics) and not any(
            re.fullmatch(p, topic) for p in self.exclude
        )


def read_profile(name: str) -> Profile:
    """Read a shipped profile by its name, or any profile by the path of its YAML file.

    Raises:
        OptionError: the profile does not exist, or a value is not allowed.
    """
    folder = command_options.repository() / PROFILES
    path = Path(name) if name.endswith((".yaml", ".yml")) else folder / f"{name}.yaml"
    try:
        raw = load_yaml(read_text(path))
    except FileNotFoundError:
        shipped = ", ".join(sorted(file.stem for file in folder.glob("*.yaml")))
        raise OptionError(f"profile: {name!r} is unknown; there are: {shipped}, or use your own YAML file") from None
    except (OSError, ContentError) as error:
        raise OptionError(f"profile: {str(path)!r} cannot be read: {getattr(error, 'strerror', error)}") from error
    if not isinstance(raw, dict) or not raw.keys() <= _KEYS:
        odd = sorted(map(str, raw.keys() - _KEYS)) if isinstance(raw, dict) else [type(raw).__name__]
        raise OptionError(f"profile: {str(path)!r}: {odd[0]!r} is not allowed; {', '.join(sorted(_KEYS))}")
    packing = raw.get("compression", "lz4")
    if packing not in _PACKINGS:
        raise OptionError(f"profile: {str(path)!r}: compression {packing!r} is not allowed; {', '.join(_PACKINGS)}")
    topics = _expressions(path, raw, "topics")
    if not topics:
        raise OptionError(f"profile: {str(path)!r} has no topics")
    split, buffer = _megabytes(path, raw, "split", 1024), _megabytes(path, raw, "buffer", 256)
    return Profile(topics, _expressions(path, raw, "exclude"), packing, split, buffer)


def _expressions(path: Path, raw: dict[str, Any], key: str) -> tuple[str, ...]:
    found = raw.get(key) or []
    if not isinstance(found, list) or not all(isinstance(entry, str) for entry in found):
        raise OptionError(f"profile: {str(path)!r}: {key} is not a list of regular expressions")
    for entry in found:
        try:
            re.compile(entry)
        except re.error as error:
            raise OptionError(f"profile: {str(path)!r}: {key}: {entry!r} is no regular expression: {error}") from error
    return tuple(found)


def _megabytes(path: Path, raw: dict[str, Any], key: str, usual: int) -> int:
    value = raw.get(key, usual)
    if not isinstance(value, int) or isinstance(value, bool) or not 1 <= value <= _MOST:
        raise OptionError(f"profile: {str(path)!r}: {key} {value!r} is not allowed; 1 to {_MOST} MB")
    return value


def rosbag_arguments(profile: Profile, out: str, duration: str | None = None, more: Sequence[str] = ()) -> list[str]:
    """Return the arguments of ``rosbag``.

    Args:
        profile: recording settings.
        out: path of the files, without number and extension.
        duration: of the recording; None for unlimited. A limited recording is one file, because rosbag applies the
            duration to each file of a split one.
        more: further arguments.
    """
    arguments = ["record", "-e", "-O", out, f"--buffsize={profile.buffer}", *_PACKINGS[profile.compression]]
    arguments += ["--split", f"--size={profile.split}"] if duration is None else [f"--duration={duration}"]
    if profile.exclude:
        arguments += ["-x", "|".join(f"({entry})" for entry in profile.exclude)]
    return [*arguments, *more, *profile.topics]


def ros_environment(given: str, launched: bool) -> tuple[dict[str, str], str]:
    """Return the environment of the recorder, and the origin of its ROS master if that was searched for.

    The master is that of ROS_MASTER_URI if a simulator uses it; else that of this workspace's newest flight; else that
    of ROS_MASTER_URI even without a simulator, e.g. for real UAVs.

    Args:
        given: the master's URI, or empty.
        launched: started by roslaunch, which sets the master.

    Raises:
        simulation_services.SimError: no master answers.
    """
    environment = dict(os.environ)
    usual = environment.get("ROS_MASTER_URI", "")
    if launched:
        return environment, ""
    try:
        master, origin = simulation_services.choose_master(given, usual, [Path("runs"), simulation_services.RUNS])
    except simulation_services.SimError:
        if not _answers(usual or simulation_services.DEFAULT_MASTER):
            raise
        return environment, ""
    if given and not _answers(master):
        raise simulation_services.SimError(f"master: none answers at {master}")
    environment["ROS_MASTER_URI"] = master
    if origin and not {"ROS_IP", "ROS_HOSTNAME"} & environment.keys():
        environment["ROS_IP"] = "127.0.0.1"
    return environment, origin


def _answers(master: str) -> bool:
    try:
        simulation_services.find_service(master, "/rosout/get_loggers")
    except (OSError, simulation_services.SimError):
        return False
    return True


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments."""
    parser.description = (
        "Record a running flight with rosbag, until Ctrl-C. Profiles: light, full (all except images), "
        "cameras, slam, or your own YAML file."
    )
    add = parser.add_argument
    add("profile", help="light, full, cameras, slam, or FILE.yaml")
    add("--out", metavar="NAME", help="path of the files without number and suffix (default: runs/<time>-<profile>)")
    add("--split", metavar="MB", type=int, help="start a new file after this many MB (default: from the profile)")
    add("--duration", metavar="TIME", help="record one file for this time: 30 (s), 5m, 2h (default: until Ctrl-C)")
    add("--master", metavar="PORT|URI", type=simulation_services.master_uri,
        help="the flight's ROS master (default: ROS_MASTER_URI; without a simulator there, the newest flight of "
        "./xtdrone demo)")  # fmt: skip


def parse(parser: argparse.ArgumentParser, words: Sequence[str]) -> argparse.Namespace:
    """Parse a command line; unknown words are kept in ``ros``, for a node's remappings."""
    arguments, ros = parser.parse_known_args(words)
    arguments.ros = ros
    return arguments


def run(arguments: argparse.Namespace) -> int:
    """Replace this process by rosbag, or return an exit status."""
    ros = arguments.ros
    try:
        odd = [argument for argument in ros if ":=" not in argument]
        if odd:
            raise OptionError(f"record: {odd[0]!r} is not allowed; see record --help")
        profile = read_profile(arguments.profile)
        if arguments.split is not None and arguments.duration is not None:
            raise OptionError("split: cannot be combined with --duration, which records one file")
        if arguments.split is not None:
            if not 1 <= arguments.split <= _MOST:
                raise OptionError(f"split: {arguments.split} is not allowed; 1 to {_MOST} MB")
            profile = Profile(profile.topics, profile.exclude, profile.compression, arguments.split, profile.buffer)
        if arguments.duration and not re.fullmatch(r"[0-9]+[smh]?", arguments.duration):
            raise OptionError(f"duration: {arguments.duration!r} is not allowed; as 30, 5m, 2h")
        out = Path(arguments.out or f"runs/{time.strftime('%Y%m%d-%H%M%S')}-{Path(arguments.profile).stem}")
        try:
            out.parent.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise OptionError(f"out: {str(out)!r} cannot be written to: {error.strerror}") from error
        program = shutil.which("rosbag")
        if program is None:
            raise OptionError("record: rosbag is not installed; './xtdrone setup' installs it")
        launched = any(argument.startswith("__name:=") for argument in ros)
        environment, origin = ros_environment(arguments.master or "", launched)
    except OptionError as error:
        print(f"xtdrone: {error}", file=sys.stderr)
        return 2
    except simulation_services.SimError as error:
        print(f"xtdrone: {error}", file=sys.stderr)
        return 1
    if origin:
        print(f"xtdrone: {origin}, ROS master {environment['ROS_MASTER_URI']}", file=sys.stderr)
    print(end="", flush=True)
    os.execve(program, [program, *rosbag_arguments(profile, str(out), arguments.duration, ros)], environment)
