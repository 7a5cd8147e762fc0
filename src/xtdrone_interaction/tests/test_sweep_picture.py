"""Pictures of sweeps: selection, plotted means, and rejections."""

from __future__ import annotations

import math
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from matplotlib import pyplot as plt

from xtdrone_interaction.studies.result_store import Store
from xtdrone_interaction.studies.study_parameters import StudyError
from xtdrone_interaction.studies.sweep_picture import Results, draw, read_results, save_picture


@pytest.fixture(autouse=True)
def _close() -> Iterator[None]:
    yield
    plt.close("all")


def results(**parameters: list[Any]) -> Results:
    """Return a grid of runs with three seeds: the figure is the sum of the numbers, plus the seed."""
    names = list(parameters)
    grid = np.meshgrid(*[np.arange(len(v)) for v in parameters.values()], [0, 1, 2], indexing="ij")
    columns: dict[str, list[Any]] = {
        name: [parameters[name][i] for i in grid[k].ravel()] for k, name in enumerate(names)
    }
    columns["seed"] = grid[-1].ravel().tolist()
    columns["error"] = [None] * len(columns["seed"])
    numbers = [columns[name] for name in [*names, "seed"] if not isinstance(columns[name][0], str)]
    columns["settling_time"] = [float(sum(row)) for row in zip(*numbers, strict=True)]
    return Results("some", columns, tuple(names), ("settling_time", "own"))


def test_one_parameter_is_a_line_of_means_with_its_spread() -> None:
    axes = draw(results(n=[4, 6, 9])).axes[0]
    (line,) = axes.get_lines()
    assert line.get_xdata().tolist() == [4, 6, 9]
    assert line.get_ydata().tolist() == [5, 7, 10]
    (band,) = axes.collections
    heights = band.get_paths()[0].vertices[:, 1]
    assert heights.min() == pytest.approx(5 - math.sqrt(2 / 3))
    assert heights.max() == pytest.approx(10 + math.sqrt(2 / 3))
    assert (axes.get_xlabel(), axes.get_ylabel()) == ("n", "settling time (s)")
    assert axes.get_title() == "some: 9 runs, 3 seeds, mean and standard deviation"


def test_the_longer_numbers_are_the_axis_and_texts_are_lines() -> None:
    axes = draw(results(patterns=["cube", "pyramid"], gain=[0.5, 1.0, 2.0])).axes[0]
    assert axes.get_xlabel() == "gain"
    assert axes.get_xscale() == "log"
    assert [text.get_text() for text in axes.get_legend().get_texts()] == ["cube", "pyramid"]
    axes = draw(results(patterns=["cube", "pyramid"])).axes[0]
    assert [text.get_text() for text in axes.get_xticklabels()] == ["cube", "pyramid"]


def test_what_is_not_shown_is_pooled_by_name_and_the_greatest_effect_is_shown() -> None:
    studied = results(ki=[0, 1, 2, 3], k_rep=[1, 1.5], vel_max=[1, 2])  # the sum changes most with ki, then vel_max
    axes = draw(studied).axes[0]
    assert axes.get_xlabel() == "ki"
    assert axes.get_legend().get_title().get_text() == "vel_max"
    assert axes.get_title().splitlines()[1] == "pooled: k_rep (1, 1.5)"
    axes = draw(studied, by="k_rep").axes[0]
    assert axes.get_title().splitlines()[1] == "pooled: vel_max (1, 2)"
    assert "pooled" not in draw(results(ki=[0, 1, 2, 3], k_rep=[1, 1.5])).axes[0].get_title()


def test_many_values_of_two_numbers_are_a_map() -> None:
    shown = draw(results(a=list(range(9)), b=list(range(10))))
    axes, scale = shown.axes
    assert (axes.get_xlabel(), axes.get_ylabel(), scale.get_ylabel()) == ("b", "a", "settling time (s)")
    values = axes.collections[0].get_array()
    assert values is not None
    assert values.reshape(9, 10)[8, 9] == pytest.approx(18.0)


def test_wanted_names_count_and_missing_figures_are_counted() -> None:
    some = results(a=[1, 2], b=[3, 4])
    some.columns["own"] = [None] * 11 + [2.0]
    some.columns["settling_time"][0] = None
    some.columns["error"][1], some.columns["settling_time"][1] = "it broke", None
    axes = draw(some, "own", "b", "a").axes[0]
    assert (axes.get_xlabel(), axes.get_ylabel()) == ("b", "own")
    assert draw(some).axes[0].get_title().endswith("1 failed, 1 not settled")


def test_rejects_by_name(tmp_path: Path) -> None:
    some = results(a=[1, 2])
    with pytest.raises(StudyError, match="metric: 'beauty' is unknown; there are: settling_time, own"):
        draw(some, "beauty")
    with pytest.raises(StudyError, match="x: 'z' is not varied in this study; there are: a, seed"):
        draw(some, x="z")
    some.columns["settling_time"] = [None] * 6
    some.columns["own"] = [None] * 6
    with pytest.raises(StudyError, match="no run has any figure"):
        draw(some)
    with pytest.raises(StudyError, match=r"results: .*none\.parquet"):
        read_results(tmp_path / "none.parquet")
    (tmp_path / "bad.parquet").write_text("no")
    with pytest.raises(StudyError, match=r"bad\.parquet is not of a sweep"):
        read_results(tmp_path / "bad.parquet")


def test_picture_of_a_file(tmp_path: Path) -> None:
    header = {"study": {"name": "s", "parameters": {"n": [4, 5]}, "constants": {}}}
    columns = {"key": str, "seed": int, "n": int, "error": str, "settling_time": float}
    with Store(tmp_path, columns, header) as store:
        store.add([{"key": str(n), "seed": 0, "n": n, "error": None, "settling_time": 2.0 * n} for n in (4, 5)])
        file = store.finish(["4", "5"])
    save_picture(file, tmp_path / "a.png")
    assert plt.imread(tmp_path / "a.png").std() > 0.0
    assert read_results(file).figures == ("settling_time",)
