"""``./xtdrone demo explore``: values that are not allowed. The tutorial on exploring a floor has the flight."""

from __future__ import annotations

from pathlib import Path

import pytest

from xtdrone_interaction import cli
from xtdrone_interaction.missions.exploration.report import unsaved_maps

pytest.importorskip("rospy")


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (["--bounds", "1,2,3"], "x0,y0,x1,y1"),
        (["--bounds", "5,0,1,4"], "x0 < x1"),
        (["--n", "0"], "1 to 6"),
        (["--n", "1", "--merge"], "n: 1 is not allowed with --merge, 2 to 6"),
        (["--loss", "0.9"], "0 to 0.5"),
        (["--world", "indor"], "'indor' is unknown"),
    ],
)
def test_values_that_are_not_allowed_are_named(
    options: list[str], words: str, capsys: pytest.CaptureFixture[str]
) -> None:
    try:
        status = cli.main(["demo", "explore", *options])
    except SystemExit as ended:  # argparse exits
        status = int(str(ended.code))
    assert status == 2
    assert words in capsys.readouterr().err


def test_maps_that_were_not_saved_are_named(tmp_path: Path) -> None:
    assert unsaved_maps(tmp_path, ["iris_0"]) == ["map.bt"]
    (tmp_path / "map.iris_0.bt").touch()
    assert unsaved_maps(tmp_path, ["iris_0", "iris_1"]) == ["map.iris_1.bt"]
