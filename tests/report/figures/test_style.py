from __future__ import annotations

import itertools
import xml.etree.ElementTree as ElementTree
from pathlib import Path

import numpy as np
import pytest
from matplotlib.colors import to_rgb
from matplotlib.figure import Figure
from matplotlib.image import imread

from ril.report.figures.style import INK, as_svg, house_style, method_style, save

METHODS = ("DQN₁", "DQN₂", "PPO", "ACKTR", "BC", "GAIL", "ILPO", "IUPE", "RIL", "RIL*")
UNKNOWN = ("ril_consistent", "another", "one", "more", "of these")


def luminance(color: str) -> float:
    """As WCAG 2 has it."""
    value = np.array(to_rgb(color))
    linear = np.where(value <= 0.04045, value / 12.92, ((value + 0.055) / 1.055) ** 2.4)
    return float(linear @ [0.2126, 0.7152, 0.0722])


def contrast(one: str, other: str) -> float:
    light, dark = sorted((luminance(one), luminance(other)), reverse=True)
    return (light + 0.05) / (dark + 0.05)


@pytest.fixture(scope="module")
def figure() -> Figure:
    with house_style():
        drawn = Figure((4, 3), layout="constrained", label="Returns & <losses>")
        axes = drawn.subplots()
        axes.plot([1, 2, 3], [0.123456789, 2, 1], marker="o", label="RIL")
        axes.fill_between([1, 2], [0, 0], [1, 1])
        axes.set(title="Title", xlabel="samples", ylabel="return")
        axes.legend()
    return drawn


@pytest.fixture(scope="module")
def svg(figure: Figure) -> str:
    return as_svg(figure, "it")


@pytest.fixture(scope="module")
def root(svg: str) -> ElementTree.Element:
    return ElementTree.fromstring(svg)


@pytest.mark.parametrize("background", ["#ffffff", "#16181d"])
@pytest.mark.parametrize("method", METHODS + UNKNOWN)
def test_a_color_is_legible_on_paper_and_on_a_dark_page(method: str, background: str) -> None:
    assert contrast(method_style(method).color, background) > 2.6


@pytest.mark.parametrize(("one", "other"), list(itertools.combinations(METHODS, 2)))
def test_two_methods_differ_in_color_and_without_it(one: str, other: str) -> None:
    assert (
        np.ptp([to_rgb(method_style(one).color), to_rgb(method_style(other).color)], axis=0).max()
        > 0.1
    )
    assert method_style(one).marker != method_style(other).marker


@pytest.mark.parametrize("method", METHODS)
def test_an_unknown_method_never_resembles_a_known_one(method: str) -> None:
    assert all(method_style(name).color != method_style(method).color for name in UNKNOWN)
    assert all(method_style(name).marker != method_style(method).marker for name in UNKNOWN)


def test_an_unknown_methods_style_is_always_the_same() -> None:
    assert method_style("ril_consistent").color == "#7d7a2e"  # of Python's own hash it would vary


def test_the_style_ends_with_its_block() -> None:
    before = Figure().get_facecolor()
    with house_style():
        assert Figure().get_facecolor() != before
    assert Figure().get_facecolor() == before


def test_a_figure_is_saved_as_vectors_and_as_pixels(tmp_path: Path, figure: Figure) -> None:
    assert save(figure, tmp_path, "it") == [tmp_path / "it.pdf", tmp_path / "it.png"]
    assert (tmp_path / "it.pdf").read_bytes().startswith(b"%PDF")
    assert (tmp_path / "it.png").read_bytes().startswith(b"\x89PNG")


def test_a_saved_figure_is_the_same_bytes_each_time(
    tmp_path: Path, figure: Figure, monkeypatch: pytest.MonkeyPatch
) -> None:
    first = [path.read_bytes() for path in save(figure, tmp_path, "it")]
    as_svg(figure, "it")
    monkeypatch.setenv("SOURCE_DATE_EPOCH", "1000000000")
    assert [path.read_bytes() for path in save(figure, tmp_path, "it")] == first


def test_a_saved_figure_is_on_white(tmp_path: Path, figure: Figure) -> None:
    save(figure, tmp_path, "it")
    np.testing.assert_array_equal(imread(tmp_path / "it.png")[0, 0], 1)


def test_an_inline_figure_is_an_element_as_wide_as_its_place(root: ElementTree.Element) -> None:
    assert root.tag == "{http://www.w3.org/2000/svg}svg"
    assert (root.get("width"), root.get("viewBox")) == ("100%", "0 0 288 216")
    assert root.get("height") is None


def test_an_inline_figure_says_what_it_is(root: ElementTree.Element) -> None:
    assert (root.get("role"), root.get("aria-label")) == ("img", "Returns & <losses>")


def test_an_inline_figure_has_the_pages_ink(svg: str, root: ElementTree.Element) -> None:
    assert INK not in svg
    texts = list(root.iter("{http://www.w3.org/2000/svg}text"))
    assert texts
    assert all("fill: currentColor" in text.get("style", "") for text in texts)


def test_an_inline_figure_keeps_its_text_as_text(root: ElementTree.Element) -> None:
    texts = root.iter("{http://www.w3.org/2000/svg}text")
    assert {"Title", "samples", "return", "RIL"} <= {text.text for text in texts}


@pytest.mark.parametrize("harm", ["<script", "<style", "<!DOCTYPE", "<?xml", "DejaVu"])
def test_an_inline_figure_does_nothing_to_its_page(harm: str, svg: str) -> None:
    assert harm not in svg


def test_an_inline_figure_has_no_background(root: ElementTree.Element) -> None:
    [page, *_] = root.iter("{http://www.w3.org/2000/svg}path")
    assert page.get("style") == "fill: none"


def test_inline_figures_of_one_page_share_no_ids(figure: Figure) -> None:
    ids = [
        element.get("id")
        for name in ("one", "two")
        for element in ElementTree.fromstring(as_svg(figure, name)).iter()
        if element.get("id")
    ]
    assert len(ids) == len(set(ids)) > 0


def test_an_inline_figure_refers_only_to_its_own_parts(root: ElementTree.Element) -> None:
    ids = {element.get("id") for element in root.iter()}
    values = [value for element in root.iter() for value in element.attrib.values()]
    referred = [value[1:] for value in values if value.startswith("#")]
    referred += [value[5:-1] for value in values if value.startswith("url(#")]
    assert ids >= set(referred) > set()


def test_an_inline_figure_is_the_same_each_time(tmp_path: Path, figure: Figure) -> None:
    first = as_svg(figure, "it")
    save(figure, tmp_path, "it")
    assert as_svg(figure, "it") == first
