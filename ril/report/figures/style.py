"""The figures' one house style: on paper, on a light or dark page, and for colour-blind people."""

from __future__ import annotations

import io
import re
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NamedTuple
from xml.sax.saxutils import quoteattr
from zlib import crc32

import matplotlib
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from ril.io.files import write_atomically

#: All text, axes and ticks. A page replaces it by its own ink, so no data may have it but
#: what should follow the page too: the paper's numbers and the references.
INK = "#1f2328"
WIDTH = 7.0  # inches: the width of a page's text
SMALL = 7.0  # points: the smallest text
_FONT = "DejaVu Sans"  # comes with matplotlib, and is wider than any of:
_PAGE_FONTS = "system-ui, -apple-system, 'Segoe UI', Roboto, 'Helvetica Neue', Arial, sans-serif"


class Look(NamedTuple):
    """How a method is drawn, everywhere: no two known ones share a colour or a marker."""

    colour: str
    marker: str
    line: str


#: Legible on white and on a dark page (contrast above 2.6 on both), and kept as far apart for
#: colour-blind people as that allows. In grey-scale it is the marker that tells them apart.
_LOOKS = {
    "Random": Look(INK, "1", "-."),
    "Expert": Look(INK, "2", "--"),
    "DQN₁": Look("#1ba4c1", "s", "-"),
    "DQN₂": Look("#2861f0", "D", "-"),
    "PPO": Look("#a074ee", "p", "-"),
    "ACKTR": Look("#715e9b", "h", "-"),
    "BC": Look("#c1934b", "v", "-"),
    "GAIL": Look("#f56aa0", "^", "-"),
    "ILPO": Look("#af3063", "<", "-"),
    "IUPE": Look("#2f8f4e", ">", "-"),
    "RIL": Look("#d9480f", "o", "-"),
    "RIL*": Look("#8f4a24", "P", "--"),
}
_OTHERS = tuple(Look(colour, "X", "-.") for colour in ("#3f7d8c", "#a05a9c", "#7d7a2e", "#b0604f"))


def look(method: str) -> Look:
    """A method's look by its title; one that is not known has the same at every call."""
    return _LOOKS.get(method) or _OTHERS[crc32(method.encode()) % len(_OTHERS)]


class Reference(NamedTuple):
    """What the returns in an environment are measured against (§4).

    Attributes:
        random: mean return of random actions.
        expert: mean return of the expert.
        solved: the return from which on the environment counts as solved, if it says one.
    """

    random: float
    expert: float
    solved: float | None = None

    @property
    def floor(self) -> float:
        """The lowest return that is drawn, so that one bad method does not squash the others."""
        return self.random - 0.15 * (self.expert - self.random)


_PARAMETERS: Any = {  # matplotlib's type for this would be a TypedDict of 300 names
    **dict.fromkeys(("text.color", "axes.labelcolor", "axes.edgecolor"), INK),
    **dict.fromkeys(("xtick.color", "ytick.color", "grid.color", "hatch.color"), INK),
    **dict.fromkeys(("figure.facecolor", "axes.facecolor", "savefig.facecolor"), "none"),
    **dict.fromkeys(("xtick.labelsize", "ytick.labelsize", "legend.fontsize"), SMALL),
    **dict.fromkeys(("axes.linewidth", "xtick.major.width", "ytick.major.width"), 0.6),
    **dict.fromkeys(("axes.spines.top", "axes.spines.right", "legend.frameon"), False),
    "font.family": _FONT,
    "font.size": 8,
    "axes.titlesize": 8.5,
    "axes.titleweight": "bold",
    "axes.labelsize": 8,
    "axes.axisbelow": True,
    "grid.alpha": 0.15,
    "grid.linewidth": 0.5,
    "lines.linewidth": 1.1,
    "lines.markersize": 4,
    "pdf.fonttype": 42,  # text stays text
    "svg.fonttype": "none",
}


@contextmanager
def house_style() -> Iterator[None]:
    """Matplotlib's parameters while a figure is made or written; a decorator, too."""
    with matplotlib.rc_context(_PARAMETERS):
        yield


def name_rows(axes: Axes, methods: Sequence[str]) -> None:
    """Give each method a row, the first at the top, at y = 0."""
    axes.set_yticks(range(len(methods)), methods)
    axes.set_ylim(len(methods) - 0.4, -0.6)
    axes.tick_params(axis="y", length=0)
    axes.grid(axis="x")
    for label in axes.get_yticklabels():
        label.set_fontweight("bold" if label.get_text() == "RIL" else "normal")


def save(figure: Figure, folder: Path, name: str) -> list[Path]:
    """Write a figure for print, as vectors and as pixels, on white.

    Args:
        figure: what to write.
        folder: an existing one.
        name: of the files, without an ending.

    Returns:
        The files, a PDF and a PNG of 300 dots per inch; the same bytes for the same figure.
    """
    undated = {"pdf": {"CreationDate": None}, "png": {"Software": None}}
    paths = [folder / f"{name}.{ending}" for ending in undated]
    for path, (ending, metadata) in zip(paths, undated.items(), strict=True):
        content = io.BytesIO()
        with house_style():
            figure.savefig(content, format=ending, metadata=metadata, facecolor="white", dpi=300)
        write_atomically(path, content.getvalue())
    return paths


def as_svg(figure: Figure, name: str) -> str:
    """A figure as an element of an HTML page, in the page's own ink and as wide as there is room.

    Args:
        figure: its label (`Figure(label=…)`) is what a screen reader says it shows.
        name: begins all ids, so that those of several figures on a page differ.

    Returns:
        One `<svg>` element.
    """
    content = io.StringIO()
    with house_style(), matplotlib.rc_context({"svg.hashsalt": name}):
        figure.savefig(content, format="svg", metadata={"Date": None})
    drawn = content.getvalue()
    # What stands before is of a file of its own: a prologue, and style for the whole document.
    drawn = drawn[drawn.index('<g id="figure_1"') :]
    drawn = re.sub(r'(id="|url\(#|href="#)', rf"\g<0>{name}-", drawn)
    # A hundredth of a point is finer than can be seen, and half the size.
    drawn = re.sub(r"(\.\d\d)\d{3,}", r"\1", drawn)
    drawn = drawn.replace(INK, "currentColor").replace(f"'{_FONT}'", "inherit")
    width, height = 72 * figure.get_size_inches()
    root = {
        "xmlns": "http://www.w3.org/2000/svg",
        "xmlns:xlink": "http://www.w3.org/1999/xlink",
        "viewBox": f"0 0 {width:g} {height:g}",
        "width": "100%",
        "role": "img",
        "aria-label": figure.get_label() or name,
        "font-family": _PAGE_FONTS,
        "stroke-linejoin": "round",
    }
    attributes = " ".join(f"{key}={quoteattr(str(value))}" for key, value in root.items())
    return f"<svg {attributes}>\n{drawn}"
