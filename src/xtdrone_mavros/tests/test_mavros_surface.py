"""Every feature of MAVROS is offered or listed as omitted, as in docs/mavros.md.

``./xtdrone shell python src/xtdrone_control/tests/test_mavros_surface.py`` writes the table of that page.
"""

from __future__ import annotations

import re
from collections import defaultdict
from pathlib import Path
from typing import NamedTuple

import pytest
import yaml
from mavros_fakes import Bench

from xtdrone_mavros.lib.plugin_settings import Params, PluginLists
from xtdrone_mavros.plugins import PLUGINS
from xtdrone_mavros.unsubscribed_topics import LEFT_OUT, explain

_DATA = Path(__file__).parent / "data" / "mavros_surface.txt"
_LISTS = Path(__file__).parents[1] / "mavros" / "launch" / "px4_pluginlists.yaml"
_PAGE = Path(__file__).parents[3] / "docs" / "mavros.md"
_TABLE = re.compile(r"(?<=<!-- made by test_mavros_surface.py -->\n).*?(?=<!-- end -->)", re.DOTALL)
# Features of a node without plugins: rospy's, and the transforms that a parameter enables.
_OTHERS = {
    "published /rosout rosgraph_msgs/Log",
    "published /tf tf2_msgs/TFMessage",
    "service get_loggers roscpp/GetLoggers",
    "service set_logger_level roscpp/SetLoggerLevel",
}


class Offered(NamedTuple):
    """One topic or service: "published", "subscribed" or "service", its name below the namespace, and its type."""

    direction: str
    name: str
    kind: str


def mavros() -> set[Offered]:
    """Return MAVROS's features."""
    lines = [line.split() for line in _DATA.read_text().splitlines() if not line.startswith("#")]
    return {Offered(direction, _short(name), kind) for direction, name, kind in lines}


def ours() -> dict[Offered, str]:
    """Return the features offered here, each with its plugin."""
    found = {}
    for plugin in PLUGINS:
        bench = Bench([plugin])
        ros = bench.ros
        for direction, names in (
            ("published", ros.publishers),
            ("subscribed", ros.subscribers),
            ("service", ros.services),
        ):
            found |= {Offered(direction, _short(name), ros.kinds[name]._type): plugin.name for name in names}
        bench.close()
    return found


def left_out() -> dict[tuple[str, str], tuple[str, str]]:
    """Return direction and name of each omitted feature, with its plugin and the reason."""
    found = {}
    for plugin, entries in LEFT_OUT.items():
        for entry in entries:
            for direction, names in (
                ("published", entry.published),
                ("subscribed", entry.subscribed),
            ):
                found |= {(direction, name): (plugin, explain(entry)) for name in names}
    return found


def _short(name: str) -> str:
    return re.sub(r"^/(iris_0/)?(mavros/|(?=mavlink/))", "", name).replace("mavlink/", "/mavlink/")


def table() -> str:
    """Return the tables of the page."""
    here: defaultdict[str, list[str]] = defaultdict(list)
    known = {(entry.direction, entry.name) for entry in mavros()}
    for entry, plugin in sorted(ours().items()):
        extra = "" if (entry.direction, entry.name) in known else " (ours)"
        here[plugin].append(f"`{entry.name}`{_MARK[entry.direction]}{extra}")
    lists = PluginLists(Params(yaml.safe_load(_LISTS.read_text(encoding="utf-8"))))
    rows = [
        f"| {plugin}{'' if lists.loads(plugin) else ' (not by default)'} | {', '.join(names)} |"
        for plugin, names in sorted(here.items())
    ]
    reasons: defaultdict[tuple[str, str], list[str]] = defaultdict(list)
    for (direction, name), key in sorted(left_out().items(), key=lambda item: item[0][1]):
        reasons[key].append(f"`{name}`{_MARK[direction]}")
    for plugin, entries in LEFT_OUT.items():
        for bare in entries:
            if not (bare.published or bare.subscribed):
                reasons[plugin, explain(bare)] = ["all of it"]
    out = [f"| {plugin} | {', '.join(names)} | {why} |" for (plugin, why), names in sorted(reasons.items())]
    return "\n".join(
        [
            "",
            "| plugin | offered |",
            "|---|---|",
            *rows,
            "",
            "| plugin | left out | because |",
            "|---|---|---|",
            *out,
            "",
            "",
        ]
    )


_MARK = {"published": "", "subscribed": " ←", "service": " ()"}


@pytest.fixture(scope="module")
def offered() -> dict[Offered, str]:
    return ours()


def test_every_feature_of_mavros_is_offered_or_listed_as_missing(offered):
    neither = {e for e in mavros() - set(offered) if (e.direction, e.name) not in left_out()}
    assert {" ".join(entry) for entry in neither} <= _OTHERS


def test_offered_features_are_not_listed_as_omitted(offered):
    both = {(entry.direction, entry.name) for entry in offered} & set(left_out())
    assert not both, "to be taken out of LEFT_OUT"


def test_omitted_features_belong_to_mavros():
    assert set(left_out()) <= {(entry.direction, entry.name) for entry in mavros()}


def test_the_page_is_current():
    found = _TABLE.search(_PAGE.read_text(encoding="utf-8"))
    assert found, "the table's marks"
    assert found[0] == table(), f"run {Path(__file__).name} as a program"


if __name__ == "__main__":
    _PAGE.write_text(_TABLE.sub(lambda _: table(), _PAGE.read_text(encoding="utf-8")), encoding="utf-8")
