from __future__ import annotations

from pathlib import Path

from ril.io.paths import docs_folder
from ril.report.deviations import documents


def test_every_numbered_entry_of_the_documentation_is_found() -> None:
    found = [
        (each.name, [entry.number for entry in each.entries]) for each in documents(docs_folder())
    ]
    assert found[0][0] == "deviations"
    assert found[0][1][:3] == ["D1", "D2", "D3"]
    assert dict(found)["gail"] == ["G1", "G2", "G3", "G4", "G5"]


def test_no_number_is_given_twice() -> None:
    numbers = [entry.number for each in documents(docs_folder()) for entry in each.entries]
    assert len(numbers) == len(set(numbers))


def test_pages_of_subfolders_follow_the_general_ones(tmp_path: Path) -> None:
    (tmp_path / "methods").mkdir()
    (tmp_path / "methods" / "b.md").write_text("# B\n- **B1. Second.**\n")
    (tmp_path / "methods" / "a.md").write_text(
        "# A\nAs [all](../deviations.md).\n- **A1. First.**\n"
    )
    (tmp_path / "deviations.md").write_text("# All\n\n## D1. One\nSee [A](methods/a.md#x).\n")
    found = documents(tmp_path)
    assert [each.name for each in found] == ["deviations", "a", "b"]
    assert found[0].entries[0].body == '<p>See <a href="#a">A</a>.</p>\n'


def test_an_entry_ends_where_the_next_heading_begins(tmp_path: Path) -> None:
    text = "# All\nfirst\n\n## D1. One `x`\nof one\n\n## D2. Two\nof two\n\n## Other\nno entry\n"
    (tmp_path / "deviations.md").write_text(text)
    [found] = documents(tmp_path)
    assert [(each.number, each.title, each.body) for each in found.entries] == [
        ("D1", "One <code>x</code>", "<p>of one</p>\n"),
        ("D2", "Two", "<p>of two</p>\n"),
    ]


def test_links_between_documents_stay_in_the_page(tmp_path: Path) -> None:
    (tmp_path / "deviations.md").write_text(
        "# All\n\n## D1. One\nAs in [the other](other.md#x), [none](../none.md), [a](https://a.b).\n"
    )
    (tmp_path / "other.md").write_text("# Other\n- **O1. First.** <b>bold</b>\n- no number\n")
    first, other = documents(tmp_path)
    assert first.entries[0].body == (
        '<p>As in <a href="#other">the other</a>, none, <a href="https://a.b">a</a>.</p>\n'
    )
    assert [entry.number for entry in other.entries] == ["O1"]
    assert "<b>" not in other.entries[0].body
