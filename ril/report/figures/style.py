"""The figures' house style: for print, light and dark pages, and color-blind readers."""

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

#: Color of text, axes, the paper's numbers and references. Pages replace it by their own ink, so
#: our data must have other colors.
INK = "#1f2328"
WIDTH = 7.0  # inches: the width of a page's text
SMALL = 7.0  # points: the smallest text
_FONT = "DejaVu Sans"  # ships with matplotlib, and is wider than each of:
PAGE_FONTS = "system-ui, -apple-system, 'Segoe UI', Roboto, 'Helvetica Neue', Arial, sans-serif"


class MethodStyle(NamedTuple):
    """How figures draw a method: each method of the paper has its own color and marker."""

    color: str
    marker: str
    line: str


#: Contrast with white and with a dark page is above 2.6, and colors differ as much for color-blind
#: readers as that allows. In grayscale, markers distinguish the methods.
_METHODS = {
    "Random": MethodStyle(INK, "1", "-."),
    "Expert": MethodStyle(INK, "2", "--"),
    "DQN₁": MethodStyle("#1ba4c1", "s", "-"),
    "DQN₂": MethodStyle("#2861f0", "D", "-"),
    "PPO": MethodStyle("#a074ee", "p", "-"),
    "ACKTR": MethodStyle("#715e9b", "h", "-"),
    "BC": MethodStyle("#c1934b", "v", "-"),
    "GAIL": MethodStyle("#f56aa0", "^", "-"),
    "ILPO": MethodStyle("#af3063", "<", "-"),
    "IUPE": MethodStyle("#2f8f4e", ">", "-"),
    "RIL": MethodStyle("#d9480f", "o", "-"),
    "RIL*": MethodStyle("#8f4a24", "P", "--"),
}
_OTHERS = tuple(
    MethodStyle(color, "X", "-.") for color in ("#3f7d8c", "#a05a9c", "#7d7a2e", "#b0604f")
)


def method_style(method: str) -> MethodStyle:
    """Return a method's style; one beyond the paper has the same in every figure."""
    return _METHODS.get(method) or _OTHERS[crc32(method.encode()) % len(_OTHERS)]


class Reference(NamedTuple):
    """The reference returns of an environment (§4).

    Attributes:
        random: mean return of random actions.
        expert: mean return of the expert.
        solved: mean return from which the environment counts as solved; None without one.
    """

    random: float
    expert: float
    solved: float | None = None

    @property
    def floor(self) -> float:
        """Lowest return that is drawn, so that one bad method does not compress the others."""
        return self.random - 0.15 * (self.expert - self.random)


_PARAMETERS: Any = {  # matplotlib's own type is a TypedDict of 300 names
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
    "pdf.fonttype": 42,  # keeps text as text
    "svg.fonttype": "none",
}


@contextmanager
def house_style() -> Iterator[None]:
    """Set matplotlib's parameters while a figure is drawn or written; also a decorator."""
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
    """Write a figure on white as PDF and as PNG of 300 dots per inch.

    Args:
        figure: the figure to write.
        folder: an existing folder.
        name: the files' name, without suffix.

    Returns:
        The files; the same figure gives the same bytes.
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
    """Convert a figure to an `<svg>` element in the ink and at the width of its HTML page.

    Args:
        figure: its label (`Figure(label=…)`) describes it to screen readers.
        name: prefix of all ids, so that figures on one page share none.

    Returns:
        One `<svg>` element.
    """
    content = io.StringIO()
    with house_style(), matplotlib.rc_context({"svg.hashsalt": name}):
        figure.savefig(content, format="svg", metadata={"Date": None})
    drawn = content.getvalue()
    # Drop the prologue of a standalone file and its document-wide style.
    drawn = drawn[drawn.index('<g id="figure_1"') :]
    drawn = re.sub(r'(id="|url\(#|href="#)', rf"\g<0>{name}-", drawn)
    # A hundredth of a point is invisible, and halves the size.
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
        "font-family": PAGE_FONTS,
        "stroke-linejoin": "round",
    }
    attributes = " ".join(f"{key}={quoteattr(str(value))}" for key, value in root.items())
    return f"<svg {attributes}>\n{drawn}"
