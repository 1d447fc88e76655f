"""The documentation's numbered deviations as pieces of HTML for the report's page."""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import dataclass
from functools import partial
from pathlib import Path, PurePosixPath
from textwrap import dedent

from markdown_it import MarkdownIt
from markdown_it.rules_core import StateCore
from markdown_it.token import Token
from markupsafe import Markup

_NUMBER = re.compile(r"(?:- )?(?:\*\*|## )([A-Z]\d+)\. ?")  # "## D4. …" or "- **K4. …"


@dataclass(frozen=True)
class Entry:
    """One numbered deviation.

    Attributes:
        number: "D4", of one document only.
        title: its subject; "" for an item of a list, whose first words are its subject.
        body: the rest of its text.
    """

    number: str
    title: Markup
    body: Markup


@dataclass(frozen=True)
class Document:
    """The numbered deviations of one file.

    Attributes:
        name: the file's name, without its ending.
        title: its heading.
        entries: the entries in the file's order.
    """

    name: str
    title: Markup
    entries: tuple[Entry, ...]


def documents(folder: Path) -> list[Document]:
    """Read all documents that have numbered deviations, `deviations.md` first.

    Links between these documents lead to their places in one page; links to other files become
    plain text.

    Args:
        folder: of Markdown files, read with all of its subfolders. An entry is a second-level
            heading, or an item of a list whose first words are bold, that begins with a letter, a
            number and a full stop. Documents with entries have different file names.
    """
    markdown = MarkdownIt("commonmark", {"html": False}).enable("table")
    files = sorted(folder.rglob("*.md"), key=lambda file: (file.stem != "deviations", file))
    texts = {file: file.read_text(encoding="utf-8") for file in files}
    parts = {file: list(_parts(text, markdown.parse(text))) for file, text in texts.items()}
    kept = {file: entries for file, entries in parts.items() if entries}
    names = {file.stem for file in kept}
    markdown.core.ruler.push("links", partial(_within_the_page, names=names))
    return [
        Document(
            file.stem,
            Markup(markdown.renderInline(texts[file].partition("\n")[0].lstrip("# "))),
            tuple(
                Entry(number, Markup(markdown.renderInline(title)), Markup(markdown.render(body)))
                for number, title, body in entries
            ),
        )
        for file, entries in kept.items()
    ]


def _parts(text: str, tokens: list[Token]) -> Iterator[tuple[str, str, str]]:
    """Yield number, title and body of each entry, as Markdown."""
    lines = text.splitlines()
    heads = [token for token in tokens if token.type == "heading_open" and token.map]
    starts = [token.map[0] for token in heads if token.map]
    for token in tokens:
        if not token.map or not (match := _NUMBER.match(lines[token.map[0]])):
            continue
        first, last = token.map
        if token.type == "heading_open":
            end = min((start for start in starts if start > first), default=len(lines))
            title = lines[first][match.end() :]
            yield match[1], title, "\n".join(lines[last:end])
        elif token.type == "list_item_open":
            item = ["  " + lines[first].removeprefix("- "), *lines[first + 1 : last]]
            yield match[1], "", dedent("\n".join(item))


def _within_the_page(state: StateCore, names: set[str]) -> None:
    """Turn relative links into anchors if the page has the file, otherwise into plain text."""
    for token in state.tokens:
        kept: list[Token] = []
        dropped = False
        for child in token.children or []:
            if child.type == "link_open" and "://" not in (href := str(child.attrs["href"])):
                name = PurePosixPath(href.partition("#")[0]).stem
                child.attrs["href"] = f"#{name}"
                dropped = name not in names
            if not (dropped and child.type in ("link_open", "link_close")):
                kept.append(child)
            dropped = dropped and child.type != "link_close"
        if token.children:
            token.children = kept
