"""Fences and rally points alone, by the ground station, while time stands."""

from __future__ import annotations

import pytest
from gcs_field import FIRST, Field
from test_gcs import survey

from xtdrone_control import qgc_plan
from xtdrone_control.autopilot import plan
from xtdrone_control.qgc_plan import Plan
from xtdrone_interaction.gcs import command, exchanges


@pytest.fixture(scope="module")
def field():
    field = Field()
    yield field
    field.close()


def test_one_list_goes_up_and_down_and_the_others_stay(field, tmp_path, capsys):
    vehicle = ["--vehicle", str(FIRST)]
    path = tmp_path / "mine.plan"
    qgc_plan.write(path, survey(0))
    assert command.main(["fence", "upload", str(path), *vehicle]) == 0
    assert field.lists(0) == [0, 4, 0]
    assert "4 items of fence: sent, and come back the same" in capsys.readouterr().out
    assert command.main(["rally", "upload", str(path), *vehicle]) == 0
    assert field.lists(0) == [0, 4, 1]
    there = tmp_path / f"vehicle_{FIRST}.plan"
    qgc_plan.write(there, Plan(survey(3).mission))
    assert command.main(["fence", "download", "--to", str(tmp_path), *vehicle]) == 0
    found = qgc_plan.read(there)
    assert exchanges.difference(survey(0).fence, found.fence, plan.FENCE) == ""
    assert qgc_plan.text_of(Plan(found.mission)) == qgc_plan.text_of(Plan(survey(3).mission))
    assert command.main(["fence", "clear", *vehicle]) == 0
    assert field.lists(0) == [0, 0, 1]


def test_a_plan_without_a_fence_does_not_empty_the_vehicles(field, tmp_path, capsys):
    path = tmp_path / "mine.plan"
    qgc_plan.write(path, Plan(survey(0).mission))
    assert command.main(["fence", "upload", str(path), "--vehicle", str(FIRST)]) == 2
    assert "mine.plan: no fence in it; 'clear' empties the vehicle's" in capsys.readouterr().err


def test_a_plan_that_cannot_be_read_is_not_written_over(field, tmp_path, capsys):
    there = tmp_path / f"vehicle_{FIRST}.plan"
    there.write_text("{")
    assert command.main(["rally", "download", "--to", str(tmp_path), "--vehicle", str(FIRST)]) == 1
    assert "its rally points cannot be written" in capsys.readouterr().err
    assert there.read_text() == "{"
