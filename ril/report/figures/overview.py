"""Table 2 at a glance, as an SVG file for the README, without matplotlib: its bytes never vary."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple
from xml.sax.saxutils import escape

from ril.report.figures.style import PAGE_FONTS, Reference
from ril.report.numbers import signed


class Theme(NamedTuple):
    """Colors: of text, the paper's results, rules, our results, and inside open markers."""

    ink: str
    paper: str
    rule: str
    ours: str
    page: str


#: Colors on a light and on a dark page. Shape, fill and position carry the meaning, too.
THEMES = {
    "light": Theme("#1f2328", "#59636e", "#d1d9e0", "#0969da", "#ffffff"),
    "dark": Theme("#f0f6fc", "#9198a1", "#3d444d", "#58a6ff", "#0d1117"),
}
_LABELS, _PANEL, _GAP, _AVERAGE = 104, 146, 24, 66  # widths of the columns
_TOP, _ROW = 84, 37  # height of the head, and of a row


@dataclass(frozen=True)
class Result:
    """A mean and the range around it.

    Attributes:
        mean: mean of returns or of P.
        low: lower end of our 95 % interval, or the paper's mean minus its ±.
        high: likewise.
        reduced: whether it is from fewer seeds or a smaller budget than the paper's.
    """

    mean: float
    low: float
    high: float
    reduced: bool = False


#: Our result and the paper's; None where not run, or not in the paper.
Pair = tuple[Result | None, Result | None]


@dataclass(frozen=True)
class Line:
    """One method.

    Attributes:
        method: its name.
        returns: AER, one pair per panel.
        average: performance P over all environments.
    """

    method: str
    returns: Sequence[Pair]
    average: Pair


def overview(panels: Sequence[tuple[str, Reference]], lines: Sequence[Line], theme: str) -> str:
    """Draw a panel per environment with a row per method, ours above the paper's.

    Args:
        panels: name and reference returns of each environment.
        lines: methods, from the top.
        theme: a key of `THEMES`.

    Returns:
        The contents of an SVG file with a transparent background.
    """
    colors = THEMES[theme]
    small = f' font-size="11" fill="{colors.paper}"'
    width = _LABELS + len(panels) * (_PANEL + _GAP) + _AVERAGE
    bottom = _TOP + len(lines) * _ROW
    parts = [
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {width} {bottom + 26}" '
        f'width="{width}" height="{bottom + 26}" font-family="{PAGE_FONTS}" font-size="13" '
        f'fill="{colors.ink}" role="img" aria-label="Returns from one expert trajectory by '
        'environment and method, ours and those of Table 2 of the paper">',
        *_legend(colors, width),
    ]
    for row, line in enumerate(lines):
        y = _TOP + row * _ROW
        is_main = line.method == "RIL"
        if is_main:
            band = f'width="{width}" height="{_ROW}" rx="4" fill="{colors.ours}"'
            parts.append(f'<rect x="0" y="{y}" {band} fill-opacity="0.1"/>')
        weight = ' font-weight="700"' if is_main else ""
        is_papers = any(papers for _, papers in line.returns)
        parts.append(_text(8, y + (23 if is_papers else 17), line.method, weight))
        if not is_papers:
            parts.append(_text(8, y + 31, "not in the paper", small))
        parts += _average(line.average, width - 8, y, colors)
    parts.append(_text(width - 8, 56, "Average P", ' font-weight="600" text-anchor="end"'))
    parts.append(_text(8, bottom + 16, "episodic reward", small))
    for number, (name, reference) in enumerate(panels):
        left = _LABELS + number * (_PANEL + _GAP)
        pairs = [line.returns[number] for line in lines]
        parts += _panel(left, bottom, name, reference, pairs, colors)
    return "\n".join([*parts, "</svg>"]) + "\n"


def _legend(colors: Theme, width: int) -> Iterator[str]:
    """Explain the markers."""
    any_result = Result(0, 0, 0)
    for x, result, is_ours, text in (
        (8, any_result, True, "ours: mean and 95 % interval"),
        (268, replace(any_result, reduced=True), True, "fewer seeds or steps than the paper"),
        (568, any_result, False, "the paper: mean ±"),
    ):
        yield _bar(x, x + 26, 20, colors.ours if is_ours else colors.paper)
        yield _marker(x + 13, 20, result, is_ours, colors)
        yield _text(x + 34, 24.5, text)
    yield f'<path d="M0 36.5H{width}" stroke="{colors.rule}"/>'


def _panel(
    left: int,
    bottom: int,
    name: str,
    reference: Reference,
    pairs: Sequence[Pair],
    colors: Theme,
) -> Iterator[str]:
    """Draw the results in one environment."""
    drawn = [result for pair in pairs for result in pair if result]
    high = max([reference.expert, *(max(result.mean, result.high) for result in drawn)])
    low = reference.floor

    def position(value: float) -> float:
        return left + 6 + (max(value, low) - low) / (high - low) * (_PANEL - 12)

    yield _text(left + 6, 56, name, ' font-weight="600"')
    small = f' font-size="11" fill="{colors.paper}"'
    for tick in _ticks(low, high):
        x = position(tick)
        yield f'<path d="M{x:.1f} {_TOP}V{bottom}" stroke="{colors.rule}"/>'
        yield _text(x, bottom + 16, signed(f"{tick:g}"), small + ' text-anchor="middle"')
    for value, label in ((reference.random, "random"), (reference.expert, "expert")):
        x = position(value)
        dashes = f'stroke="{colors.ink}" stroke-dasharray="4 3" stroke-opacity="0.75"'
        yield f'<path d="M{x:.1f} {_TOP - 4}V{bottom}" {dashes}/>'
        yield _text(x, 75, label, small + ' text-anchor="middle"')
    for row, (ours, papers) in enumerate(pairs):
        y = _TOP + row * _ROW
        yield from _result(ours, True, y + 12, position, low, colors)
        yield from _result(papers, False, y + 26, position, low, colors)


def _result(
    result: Result | None,
    is_ours: bool,
    y: float,
    position: Callable[[float], float],
    low: float,
    colors: Theme,
) -> Iterator[str]:
    """Draw one result, or write it at the edge if it is off the scale."""
    if result is None:
        return
    color = colors.ours if is_ours else colors.paper
    if result.mean < low:
        text = signed(f"{result.mean:.0f}")
        halo = f'stroke="{colors.page}" stroke-width="3" paint-order="stroke"'
        yield _text(position(low) - 4, y + 4, f"◂ {text}", f' font-size="11" fill="{color}" {halo}')
        return
    yield _bar(position(result.low), position(result.high), y, color)
    yield _marker(position(result.mean), y, result, is_ours, colors)


def _average(pair: Pair, x: int, y: int, colors: Theme) -> Iterator[str]:
    """Write average P, ours above the paper's."""
    for result, color, below in zip(pair, (colors.ours, colors.paper), (16, 30), strict=True):
        if result:
            style = f' font-size="12" fill="{color}" text-anchor="end"'
            yield _text(x, y + below, signed(f"{result.mean:.2f}"), style)


def _bar(start: float, end: float, y: float, color: str) -> str:
    return f'<path d="M{start:.1f} {y}H{end:.1f}" stroke="{color}" stroke-width="2.5"/>'


def _marker(x: float, y: float, result: Result, is_ours: bool, colors: Theme) -> str:
    """Draw a circle for ours, open where reduced; a diamond for the paper's."""
    if not is_ours:
        return f'<path d="M{x:.1f} {y - 5}l5 5-5 5-5-5z" fill="{colors.paper}"/>'
    fill = colors.page if result.reduced else colors.ours
    return f'<circle cx="{x:.1f}" cy="{y}" r="4" fill="{fill}" stroke="{colors.ours}"/>'


def _text(x: float, y: float, text: str, style: str = "") -> str:
    return f'<text x="{x:.1f}" y="{y}"{style}>{escape(text)}</text>'


def _ticks(low: float, high: float) -> list[float]:
    """Choose three round values within a range."""
    for power in (10.0**exponent for exponent in range(-3, 6)):
        for step in (factor * power for factor in (1, 5, 2.5, 2, 1.5)):
            first, last = -(-low // step), high // step
            if last - first == 2:
                return [(first + at) * step for at in range(3)]
    return [low, high]
