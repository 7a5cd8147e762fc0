"""Fences and rally points by the ground station, while time is paused."""

from __future__ import annotations

import json

import pytest
from gcs_field import FIRST, Field
from test_gcs import survey

from xtdrone_autopilot.navigator import plan
from xtdrone_autopilot.navigator.plan import PlanItem
from xtdrone_autopilot.plans import qgc_plan
from xtdrone_autopilot.plans.qgc_plan import Plan
from xtdrone_interaction.gcs.exchanges import plans as plan_exchanges
from xtdrone_interaction.gcs_commands.gcs_cli import main


@pytest.fixture(scope="module")
def field():
    field = Field()
    yield field
    field.close()


def test_one_list_is_uploaded_and_downloaded_and_the_others_remain(field, tmp_path, capsys):
    vehicle = ["--vehicle", str(FIRST)]
    path = tmp_path / "mine.plan"
    qgc_plan.write(path, survey(0))
    assert main(["fence", "upload", str(path), *vehicle]) == 0
    assert field.lists(0) == [0, 4, 0]
    assert "4 items of fence: sent, and come back the same" in capsys.readouterr().out
    assert main(["rally", "upload", str(path), *vehicle]) == 0
    assert field.lists(0) == [0, 4, 1]
    there = tmp_path / f"vehicle_{FIRST}.plan"
    qgc_plan.write(there, Plan(survey(3).mission))
    assert main(["fence", "download", "--to", str(tmp_path), *vehicle]) == 0
    found = qgc_plan.read(there)
    assert plan_exchanges.difference(survey(0).fence, found.fence, plan.FENCE) == ""
    assert qgc_plan.text_of(Plan(found.mission)) == qgc_plan.text_of(Plan(survey(3).mission))
    assert main(["fence", "clear", *vehicle]) == 0
    assert field.lists(0) == [0, 0, 1]


def test_what_a_vehicle_stores_otherwise_is_said(field, tmp_path, capsys):
    vehicle = ["--vehicle", str(FIRST)]
    path, back = tmp_path / "mine.plan", tmp_path / "back"
    items = [
        PlanItem(plan.TAKEOFF, 3, (15.0, 0.0, 0.0, -90.0), 47.0, 8.0, 10.0),
        PlanItem(plan.JUMP, 2, (0.0, -1.0, 0.0, 0.0), 0.0, 0.0, 0.0),
        PlanItem(plan.JUMP, 2, (700.0, 1.0, 0.0, 0.0), 0.0, 0.0, 0.0),
    ]
    qgc_plan.write(path, Plan(tuple(items)))
    assert main(["upload", str(path), *vehicle]) == 0
    said = "stored in the vehicle's own form: param1 15 of item 1 as 0, param2 -1 of item 2 as 65535"
    assert f"3 items: sent, and {said}\n" in capsys.readouterr().out
    assert main(["download", "--to", str(back), *vehicle]) == 0
    assert main(["upload", str(back / f"vehicle_{FIRST}.plan"), *vehicle]) == 0
    assert "3 items: sent, and come back the same\n" in capsys.readouterr().out


def test_a_plan_without_a_fence_does_not_empty_the_vehicles(field, tmp_path, capsys):
    path = tmp_path / "mine.plan"
    qgc_plan.write(path, Plan(survey(0).mission))
    assert main(["fence", "upload", str(path), "--vehicle", str(FIRST)]) == 2
    assert "mine.plan: no fence in it; 'clear' empties the vehicle's" in capsys.readouterr().err


def test_a_plan_that_cannot_be_read_is_not_written_over(field, tmp_path, capsys):
    there = tmp_path / f"vehicle_{FIRST}.plan"
    there.write_text("{")
    assert main(["rally", "download", "--to", str(tmp_path), "--vehicle", str(FIRST)]) == 1
    assert "its rally points cannot be written" in capsys.readouterr().err
    assert there.read_text() == "{"


@pytest.mark.parametrize(("firmware", "words"), [(3, "ArduPilot"), (0, "no autopilot in particular")])
def test_a_plan_for_another_autopilot_is_accepted_with_a_note(field, tmp_path, capsys, firmware, words):
    path = tmp_path / "mine.plan"
    document = json.loads(qgc_plan.text_of(survey(0)))
    document["mission"]["firmwareType"] = firmware
    path.write_text(json.dumps(document))
    assert main(["upload", str(path), "--vehicle", str(FIRST)]) == 0
    assert f"mine.plan: drawn for {words}, its items are interpreted as PX4 interprets them" in capsys.readouterr().err
    assert field.lists(0) == [9, 4, 1]
    assert json.loads(qgc_plan.text_of(qgc_plan.read(path)))["mission"]["firmwareType"] == firmware
