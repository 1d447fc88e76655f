from __future__ import annotations

from xml.etree import ElementTree

import pytest

from ril.report.figures.overview import THEMES, Line, Result, overview
from ril.report.figures.style import Reference

NONE = (None, None)
PANELS = [
    ("CartPole", Reference(20.0, 500.0)),
    ("Acrobot", Reference(-500.0, -85.0)),
    ("MountainCar", Reference(-200.0, -106.0)),
    ("LunarLander", Reference(-180.0, 236.0)),
]
LINES = [
    Line("BC", [(Result(400, 380, 420), Result(300, 250, 350)), NONE, NONE, NONE], NONE),
    Line(
        "RIL",
        [
            (Result(500, 500, 500, True), Result(500, 500, 500)),
            (Result(-600, -650, -550), None),
            NONE,
            NONE,
        ],
        (Result(1.02, 1, 1.03), Result(1.04, 1.01, 1.07)),
    ),
    Line("new <method>", [(Result(450, 440, 460), None), NONE, NONE, NONE], NONE),
]
SVG = "{http://www.w3.org/2000/svg}"


@pytest.fixture(scope="module", params=THEMES)
def root(request: pytest.FixtureRequest) -> ElementTree.Element:
    return ElementTree.fromstring(overview(PANELS, LINES, request.param))


def texts(root: ElementTree.Element) -> list[str]:
    return [element.text or "" for element in root.iter(f"{SVG}text")]


def test_methods_and_environments_are_named(root: ElementTree.Element) -> None:
    assert {"BC", "RIL", "new <method>", "CartPole", "Acrobot", "random", "expert"} <= set(
        texts(root)
    )


def test_a_method_beyond_the_paper_is_marked(root: ElementTree.Element) -> None:
    assert texts(root).count("not in the paper") == 1


def test_average_performance_is_written(root: ElementTree.Element) -> None:
    assert {"1.02", "1.04"} <= set(texts(root))


def test_a_result_below_the_scale_is_written_at_the_edge(root: ElementTree.Element) -> None:
    assert "◂ −600" in texts(root)


def test_circles_are_ours_and_open_where_reduced(root: ElementTree.Element) -> None:
    circles = [circle for circle in root.iter(f"{SVG}circle") if float(circle.get("cy", 0)) > 40]
    assert [circle.get("fill") == circle.get("stroke") for circle in circles] == [
        True,
        False,
        True,
    ]


def test_a_higher_return_is_further_to_the_right(root: ElementTree.Element) -> None:
    circles = [circle for circle in root.iter(f"{SVG}circle") if float(circle.get("cy", 0)) > 40]
    bc, ril, new = (float(circle.get("cx", 0)) for circle in circles)
    assert bc < new < ril


def test_everything_is_within_the_drawing(root: ElementTree.Element) -> None:
    width, height = float(root.get("width", 0)), float(root.get("height", 0))
    for text in root.iter(f"{SVG}text"):
        assert 0 <= float(text.get("x", -1)) <= width
        assert 0 <= float(text.get("y", -1)) <= height


def test_themes_differ_in_colors_only() -> None:
    light, dark = (overview(PANELS, LINES, theme) for theme in ("light", "dark"))
    for one, other in zip(THEMES["light"], THEMES["dark"], strict=True):
        light = light.replace(one, "color")
        dark = dark.replace(other, "color")
    assert light == dark
