"""The ground station with the autopilot's MAVLink servers over UDP, while simulated time is paused."""

from __future__ import annotations

import io
import json
import socket

import pytest
from gcs_field import COUNT, HOME, Field, LossyLine

from xtdrone_autopilot.navigator import plan
from xtdrone_autopilot.navigator.plan import PlanItem
from xtdrone_autopilot.plans import qgc_plan
from xtdrone_autopilot.plans.qgc_plan import Plan
from xtdrone_interaction.gcs import GcsError, Peer, peers_of, station, upload_plans
from xtdrone_interaction.gcs.exchanges import plans as plan_exchanges
from xtdrone_interaction.gcs_commands import terminal_output
from xtdrone_interaction.gcs_commands.gcs_cli import main

NAN = float("nan")
PATIENCE = 120.0  # s; only a broken run takes so long


def waypoint(north, east=0.0, command_=plan.WAYPOINT, yaw=NAN):
    return PlanItem(command_, 3, (0.0, 0.0, 0.0, yaw), HOME[0] + north * 1e-5, HOME[1] + east * 1e-5, 10.0)


def survey(start):
    """Return a plan with all kinds of lists, different for each ``start``."""
    turns = [waypoint(start + 3 * i, 5 * (i % 2), yaw=-90.1) for i in range(6)]
    jump = PlanItem(plan.JUMP, 2, (1.0, 2.0, 0.0, 0.0), 0.0, 0.0, 0.0)
    gimbal = PlanItem(plan.MOUNT_CONTROL, 2, (-60.0, 0.0, 0.0, NAN), 0.0, 0.0, 2.0)
    corners = [(-1, -1), (1, -1), (1, 1), (-1, 1)]
    fence = [PlanItem(plan.FENCE_INCLUSION, 0, (4.0, 0.0, 0.0, 0.0), HOME[0] + x, HOME[1] + y, 0.0, False)
             for x, y in corners]  # fmt: skip
    rally = PlanItem(plan.RALLY_POINT, 3, (0.0,) * 4, *HOME, 30.0, False)
    return Plan((waypoint(start, command_=plan.TAKEOFF), gimbal, *turns, jump), tuple(fence), (rally,), (*HOME, 488.0))


@pytest.fixture
def field():
    field = Field()
    yield field
    field.close()


@pytest.fixture
def as_named(field, monkeypatch):
    """Resolve the field's vehicles by name, at the field's ports."""
    known = {peer.name: peer for peer in field.peers()}
    monkeypatch.setattr(station, "peers_of", lambda names, *_: [known[name] for name in names])
    return field


def run(jobs, timeout=0.05):
    return station.run(jobs, timeout=timeout, patience=PATIENCE)


def test_uploaded_plans_can_be_downloaded_from_all_vehicles(field, as_named):
    plans = {name: survey(10 * i) for i, name in enumerate(field.names)}
    seen = []
    upload_plans(plans, watch=lambda *progress: seen.append(progress), patience=PATIENCE)
    assert [field.lists(i) for i in range(COUNT)] == [[9, 4, 1]] * COUNT
    assert {name for name, *_ in seen} == set(field.names)
    assert {what for _, what, *_ in seen} >= {"sending mission", "reading mission", "sending fence"}
    back = run({peer: plan_exchanges.download_plan(peer.system) for peer in field.peers()})
    for name, content in plans.items():
        for kind in plan.KINDS:
            assert plan_exchanges.difference(content.items(kind), back[name].items(kind), kind) == ""
    assert back[field.names[0]].mission[3].params[3] == pytest.approx(269.9)  # PX4's form of headings


@pytest.mark.parametrize("seed", range(2))
def test_it_works_over_a_line_that_loses_a_third(field, seed):
    line = LossyLine(field.ports, 0.3, seed)
    try:
        peers = [Peer(v.name, v.system_id, "127.0.0.1", line.ports[v.name]) for v in field.vehicles]
        plans = {peer: survey(10 * i) for i, peer in enumerate(peers)}
        stored = run({peer: plan_exchanges.upload_plan(peer.system, plans[peer]) for peer in peers}, 0.02)
        assert [str(result) for result in stored.values() if isinstance(result, GcsError)] == []
        assert [field.lists(i) for i in range(COUNT)] == [[9, 4, 1]] * COUNT
        for peer, found in run({peer: plan_exchanges.download_plan(peer.system) for peer in peers}, 0.02).items():
            assert isinstance(found, Plan), found
            content = survey(10 * field.names.index(peer))
            assert plan_exchanges.difference(content.mission, found.mission, plan.MISSION) == ""
        run({peer: plan_exchanges.clear_plan(peer.system) for peer in peers}, 0.02)
        assert [field.lists(i) for i in range(COUNT)] == [[0, 0, 0]] * COUNT
    finally:
        line.close()
    assert line.lost > 50


def test_an_existing_plan_is_replaced_completely(field):
    (peer, *_) = field.peers()
    run({peer: plan_exchanges.upload_plan(peer.system, survey(0))})
    run({peer: plan_exchanges.upload_plan(peer.system, Plan((waypoint(1),)))})
    assert field.lists(0) == [1, 0, 0]


def test_a_rejected_upload_is_reported_and_leaves_no_partial_plan(field):
    (peer, *_) = field.peers()
    bad = Plan((waypoint(0), PlanItem(183, 2, (0.0,) * 4, 0.0, 0.0, 0.0)))
    (error,) = run({peer: plan_exchanges.upload_plan(peer.system, bad)}).values()
    assert str(error) == ("typhoon_h480_0: mission: the vehicle rejects item 2 (command 183): MAV_MISSION_UNSUPPORTED")
    assert field.lists(0) == [0, 0, 0]
    (result,) = run({peer: plan_exchanges.upload_plan(peer.system, survey(0))}).values()
    assert not isinstance(result, GcsError)


def test_an_aborted_upload_does_not_block_the_next(field):
    (peer, *_) = field.peers()

    def interrupted():
        exchange = plan_exchanges.upload_plan(peer.system, survey(0))
        answer = yield next(exchange)
        for _ in range(3):
            answer = yield exchange.send(answer)
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        run({peer: interrupted()})
    (result,) = run({peer: plan_exchanges.upload_plan(peer.system, survey(0))}).values()
    assert not isinstance(result, GcsError)


def test_a_missing_vehicle_is_reported(field):
    unused = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    unused.bind(("127.0.0.1", 0))
    port = unused.getsockname()[1]
    first = field.peers()[0]
    peers = [Peer("iris_0", 9, "127.0.0.1", first.port), Peer("iris_1", 2, "127.0.0.1", port)]
    found = station.run({peer: plan_exchanges.download_plan(peer.system) for peer in peers}, timeout=0.02, patience=0.3)
    unused.close()
    assert str(found["iris_1"]) == f"iris_1: UDP 127.0.0.1:{port}: no answer from system 2 within 0.3 s"
    assert "no answer from system 9" in str(found["iris_0"])  # the port belongs to another vehicle
    closed = station.run({peers[1]: plan_exchanges.download_plan(2)}, timeout=0.02, patience=0.3)
    assert "no program listens there" in str(closed["iris_1"])


@pytest.mark.parametrize(
    ("names", "fleet", "where"),
    [
        (["iris_0", "iris_8"], "", [(1, 18570), (9, 18578)]),
        (["typhoon_h480_1", "iris_2"], "iris:3,typhoon_h480:2", [(5, 18574), (3, 18572)]),
    ],
)
def test_names_lead_to_ports(names, fleet, where):
    assert [(peer.system, peer.port) for peer in peers_of(names, fleet)] == where


@pytest.mark.parametrize(
    ("names", "fleet", "message"),
    [
        (["iris"], "", "'iris' is not allowed, a type and a number"),
        (["iris_0", "solo_0"], "", r"several types \(iris, solo\): specify the fleet, as --fleet iris:1,solo:1"),
        (["iris_3"], "iris:3", "'iris_3' is not allowed, one of the fleet iris:3"),
    ],
)
def test_names_that_lead_nowhere(names, fleet, message):
    with pytest.raises(GcsError, match=message):
        peers_of(names, fleet)


# ---- the command


def write_plans(folder, field):
    for i, name in enumerate(field.names):
        qgc_plan.write(folder / f"{name}.plan", survey(10 * i))


def test_the_command_uploads_downloads_and_clears(field, as_named, tmp_path, capsys):
    write_plans(tmp_path, field)
    assert main(["upload", str(tmp_path), "--patience", "60"]) == 0
    shown = capsys.readouterr().out.splitlines()
    assert shown[0].split(maxsplit=1) == [
        "typhoon_h480_0", "9 items, 4 of fence, 1 of rally points: sent, and come back the same"
    ]  # fmt: skip
    assert len(shown) == COUNT
    back = tmp_path / "back"
    vehicles = ["--vehicle", ",".join(field.names), "--patience", "60"]
    assert main(["download", *vehicles, "--to", str(back)]) == 0
    for i, name in enumerate(field.names):
        found = qgc_plan.read(back / f"{name}.plan")
        assert plan_exchanges.difference(survey(10 * i).mission, found.mission, plan.MISSION) == ""
    assert main(["clear", *vehicles]) == 0
    assert [field.lists(i) for i in range(COUNT)] == [[0, 0, 0]] * COUNT


def test_a_folder_that_cannot_be_written_to(field, as_named, capsys):
    for words in (["download"], ["fence", "download"]):
        assert main([*words, "--vehicle", field.names[0], "--to", "/proc/none", "--patience", "60"]) == 1
        assert "typhoon_h480_0: its " in capsys.readouterr().err


def test_one_file_goes_to_the_named_vehicle(field, as_named, tmp_path):
    qgc_plan.write(tmp_path / "mine.plan", survey(0))
    assert main(["upload", str(tmp_path / "mine.plan"), "--vehicle", field.names[1], "--patience", "60"]) == 0
    assert [field.lists(i)[0] for i in range(COUNT)] == [0, 9, 0]


def test_a_file_that_is_called_after_no_vehicle(tmp_path, capsys):
    qgc_plan.write(tmp_path / "mine.plan", survey(0))
    for words in (["upload"], ["fence", "upload"]):
        assert main([*words, str(tmp_path / "mine.plan")]) == 2
        assert "'mine' is not allowed" in (said := capsys.readouterr().err)
        assert "or --vehicle selects the vehicle" in said


def test_failures_set_the_exit_status(tmp_path, capsys):
    qgc_plan.write(tmp_path / "iris_249.plan", survey(0))
    assert main(["upload", str(tmp_path), "--patience", "0.2"]) == 1
    caught = capsys.readouterr()
    assert caught.out.split() == ["iris_249", "failed"]
    assert "xtdrone gcs: iris_249: UDP 127.0.0.1:18819: no program listens there" in caught.err


def test_a_bad_file_keeps_all_at_home(field, as_named, tmp_path, capsys):
    write_plans(tmp_path, field)
    document = json.loads((tmp_path / "typhoon_h480_1.plan").read_text())
    document["mission"]["items"][0]["frame"] = 10
    (tmp_path / "typhoon_h480_1.plan").write_text(json.dumps(document))
    assert main(["upload", str(tmp_path)]) == 2
    assert "typhoon_h480_1.plan: mission: items: item 1: frame: 10 is not allowed" in capsys.readouterr().err
    assert [field.lists(i) for i in range(COUNT)] == [[0, 0, 0]] * COUNT


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["upload", "{}/none.plan"], "none.plan: no such file or folder"),
        (["upload", "{}"], "no .plan or .waypoints file is in this folder"),
        (["download"], "which vehicles?"),
        (["clear", "--fleet", "iris:0"], "1 to 250 vehicles in all are allowed"),
        (["clear", "--vehicle", "iris"], "'iris' is not allowed"),
    ],
)
def test_invalid_values_are_reported(arguments, message, tmp_path, capsys):
    assert main([argument.format(tmp_path) for argument in arguments]) == 2
    assert message in capsys.readouterr().err


def test_check_reports_px4s_result(tmp_path, capsys):
    qgc_plan.write(tmp_path / "good.plan", survey(0))
    assert main(["check", str(tmp_path)]) == 0
    assert "good.plan: 9 items, 4 of fence, 1 of rally points; 25 m of path" in capsys.readouterr().out
    qgc_plan.write(tmp_path / "far.plan", Plan((waypoint(0), waypoint(1, command_=plan.TAKEOFF)), home=(*HOME, 0.0)))
    assert main(["check", str(tmp_path / "far.plan")]) == 1
    assert "Mission rejected: takeoff not first waypoint item" in capsys.readouterr().err


@pytest.mark.parametrize("content", [Plan((), fence=survey(0).fence), Plan((), rally=survey(0).rally), Plan(())])
def test_check_accepts_a_plan_without_a_mission_as_upload_does(content, tmp_path, capsys):
    qgc_plan.write(tmp_path / "part.plan", content)
    assert main(["check", str(tmp_path)]) == 0
    assert "part.plan: 0 items" in capsys.readouterr().out


def test_check_reports_the_other_files_beside_an_invalid_one(tmp_path, capsys):
    qgc_plan.write(tmp_path / "c.plan", survey(0))
    qgc_plan.write(tmp_path / "b.plan", Plan((waypoint(0), waypoint(1, command_=plan.TAKEOFF)), home=(*HOME, 0.0)))
    (tmp_path / "a.plan").write_text("{")
    (tmp_path / "d.waypoints").write_text("QGC WPL 120\n0\t0\t2\t177\t8\t1\t0\t0\t0\t0\t0\t1\n")
    assert main(["check", str(tmp_path), str(tmp_path / "none.plan")]) == 2
    said = capsys.readouterr()
    assert "c.plan: 9 items" in said.out
    assert "b.plan: 2 items" in said.out
    assert "takeoff not first waypoint item" in said.err
    assert "a.plan: is not JSON" in said.err
    assert "none.plan: no such file or folder" in said.err
    assert "d.waypoints: Warning: item 1 jumps to item 9 of 1, where PX4 ends the mission" in said.err


@pytest.fixture
def terminal(monkeypatch):
    """Return the output on a terminal of 30 columns and 4 rows."""
    monkeypatch.setenv("TERM", "xterm")
    monkeypatch.setenv("COLUMNS", "30")
    monkeypatch.setenv("LINES", "4")
    file = io.StringIO()
    file.isatty = lambda: True
    return file


def test_a_terminal_shows_what_fits_and_everything_at_the_end(terminal, monkeypatch):
    names = [f"iris_{i}" for i in range(5)]
    monkeypatch.setattr(terminal_output, "_REDRAW", 0.0)
    shown = terminal_output.Display(names, terminal)
    assert "iris_0  waiting" in terminal.getvalue()
    shown.watch("iris_0", "sending", 3, 9)
    assert "iris_0  sending 3/9" in terminal.getvalue()
    assert "... and 3 more" in terminal.getvalue()
    peers = [Peer(name, 1, "h", 1) for name in names]
    seen = len(terminal.getvalue())
    assert shown.results(peers, dict.fromkeys(names), lambda name, _: f"{name} has it") == 0
    assert terminal.getvalue()[seen:] == "\x1b[3A\x1b[J" + "".join(f"{name}  {name} has it\n" for name in names)


def test_without_a_terminal_only_the_results_are_printed(terminal, monkeypatch):
    monkeypatch.setenv("TERM", "dumb")
    shown = terminal_output.Display(["iris_0"], terminal)
    shown.watch("iris_0", "sending mission", 3, 9)
    shown.results([Peer("iris_0", 1, "h", 1)], {"iris_0": GcsError("iris_0: no")}, lambda *_: "")
    assert terminal.getvalue() == "iris_0  failed\n"
