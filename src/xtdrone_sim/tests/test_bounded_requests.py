"""Requests with models are refused in bounded time before they can slow the world down or read other files."""

from __future__ import annotations

import time
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from xtdrone_common.fleet import parse_fleet
from xtdrone_common.poses import Pose
from xtdrone_sim.gazebo.models_by_name import Models
from xtdrone_sim.gazebo.models_in_requests import model_of_urdf
from xtdrone_sim.gazebo.request_limits import RequestError
from xtdrone_sim.gazebo.states import State
from xtdrone_sim.physics.bodies.movable_bodies import MOST_PAIRS
from xtdrone_sim.simulation import Simulation
from xtdrone_worlds.worlds.sdf import SdfError, SdfModel, read_model
from xtdrone_worlds.worlds.sdf.xml_elements import parse

BOX = "<collision{}><geometry><box><size>1 1 1</size></box></geometry></collision>"


def sdf(shapes: int = 1, static: bool = False) -> SdfModel:
    """Return a model of equal boxes in one place."""
    boxes = "".join(BOX.format(f' name="c{k}"') for k in range(shapes))
    text = f'<sdf version="1.6"><model name="m"><static>{static}</static><link name="l">{boxes}</link></model></sdf>'
    return read_model(text, "model_xml")


def urdf(links: int) -> str:
    """Return a chain of links, of which the first is a box."""
    box = '<collision><geometry><box size="1 1 1"/></geometry></collision>'
    names = "".join(f'<link name="l{k}">{box if k == 0 else ""}</link>' for k in range(links))
    joints = "".join(
        f'<joint name="j{k}" type="fixed"><parent link="l{k}"/><child link="l{k + 1}"/></joint>'
        for k in range(links - 1)
    )
    return f'<robot name="r">{names}{joints}</robot>'


@pytest.fixture
def models() -> Any:
    simulation = Simulation(parse_fleet("iris:1"))
    actors: Any = SimpleNamespace(names=[])
    yield Models(simulation, actors)
    simulation.close()


def fill(models: Models, model: SdfModel, pose: Pose) -> int:
    """Add a model until it is refused; return the number of those added."""
    for number in range(120):
        try:
            models.adding(f"m_{number}", model, pose, "")()
        except RequestError as error:
            if f"more than {MOST_PAIRS} pairs of shapes" not in str(error):
                raise
            return number
    return 120


@pytest.mark.parametrize(("shapes", "static", "most"), [(1, False, 25), (10, False, 3), (1, True, 120)])
def test_a_crowd_of_overlapping_models_is_bounded(models: Models, shapes: int, static: bool, most: int) -> None:
    """n boxes in one place have n (n - 1) / 2 pairs; static ones have no contacts with each other."""
    assert fill(models, sdf(shapes, static), Pose((20.0, 0.0, 0.5))) == most
    models.adding("apart", sdf(), Pose((30.0, 0.0, 0.5)), "")()


def test_a_model_is_not_moved_into_a_crowd(models: Models) -> None:
    fill(models, sdf(), Pose((20.0, 0.0, 0.5)))
    models.adding("apart", sdf(), Pose((30.0, 0.0, 0.5)), "")()
    with pytest.raises(RequestError, match="'apart' would touch others"):
        models.moving("apart", State(Pose((20.5, 0.0, 0.5))), "")
    models.moving("apart", State(Pose((25.0, 0.0, 0.5))), "")()


def test_stacked_models_are_one_crowd(models: Models) -> None:
    """A pile is refused at its limit, although each box touches few others; beyond the gap another one begins."""
    box, refused = sdf(), []
    for number in range(80):
        place = Pose((20.0 + number % 4, number // 4 % 4, 0.5 + number // 16))
        try:
            models.adding(f"m_{number}", box, place, "")()
        except RequestError:
            refused.append(number)
    assert 10 < len(refused) < 40
    assert refused[-1] < 79


@pytest.mark.parametrize(
    "uri",
    ["package://xtdrone_sim/&#46;&#46;/x.obj", "package://xtdrone_sim/&#x2e;./x.obj", "&#47;etc/x.obj",
     "file:///etc/x.obj", "x.obj"],
)  # fmt: skip
def test_a_file_outside_packages_is_refused_however_it_is_written(uri: str) -> None:
    text = f"<link name='a'><visual><geometry><mesh filename='{uri}'/></geometry></visual></link>"
    with pytest.raises(RequestError, match=r"is not allowed in a request, package://NAME/\.\.\. without"):
        model_of_urdf(f"<robot name='r'>{text}</robot>")


def test_chains_of_links_are_limited() -> None:
    assert len(model_of_urdf(urdf(101)).links) == 1
    for links, words in (
        (102, "a chain of 101 is not allowed, at most 100"),
        (9000, "9000 are not allowed, at most 1000"),
        (90_000, "more than 200000 elements"),
    ):
        with pytest.raises(RequestError, match=words):
            model_of_urdf(urdf(links))


def test_chains_and_text_of_sdf_are_read_in_linear_time() -> None:
    """Quadratic time would be minutes for these sizes."""
    begin = time.process_time()
    shape = BOX.format(' name="c"')
    links = "".join(f'<link name="l{k}">{"" if k else shape}</link>' for k in range(8000))
    joints = "".join(
        f'<joint name="j{k}" type="fixed"><parent>l{k}</parent><child>l{k + 1}</child></joint>' for k in range(7999)
    )
    model = read_model(f'<sdf version="1.6"><model name="m">{links}{joints}</model></sdf>', "model_xml")
    assert len(model.links) == 8000
    assert not model.static
    root = parse("<sdf>" + ("x" * 80 + "<b/>") * 100_000 + "</sdf>", Path("text.sdf"))
    assert len(root.text) == 8_000_000
    assert time.process_time() - begin < 30.0


def test_names_of_files_that_the_system_rejects_are_errors_of_the_reader() -> None:
    mesh = '<mesh filename="package://xtdrone_sim/{}.obj"/>'.format("a" * 500)
    with pytest.raises(RequestError, match="there is no file"):
        model_of_urdf(f'<robot name="r"><link name="a"><visual><geometry>{mesh}</geometry></visual></link></robot>')
    include = "<include><uri>model://{}</uri></include>"
    for name in ("a" * 500, "a" * 5000):
        with pytest.raises(SdfError, match=r"is in none of|5008 characters are not allowed, at most 1000"):
            read_model(f'<sdf version="1.6">{include.format(name)}</sdf>', "model_xml")
