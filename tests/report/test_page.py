from __future__ import annotations

import xml.etree.ElementTree as ET
from collections.abc import Iterator
from dataclasses import replace
from functools import cache
from html.parser import HTMLParser

import pytest
from helpers.made_report import HOSTILE, RUN, SVG, sample
from helpers.made_rows import ALONE

from ril.io.paths import docs_folder
from ril.report.deviations import documents
from ril.report.page import Drawn, page
from ril.report.paper.audit import Contradiction

VOID = {"meta", "br", "input", "link", "hr"}


class Tree(HTMLParser):
    """A page as elements; one that is not closed where it should be is an error."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.builder, self.open = ET.TreeBuilder(), list[str]()
        self.feed(text)
        self.close()
        assert self.open == []
        self.root = self.builder.close()

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.builder.start(tag, {name: value or "" for name, value in attrs})
        self.builder.end(tag) if tag in VOID else self.open.append(tag)

    def handle_endtag(self, tag: str) -> None:
        assert self.open.pop() == tag
        self.builder.end(tag)

    def handle_startendtag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.handle_starttag(tag, attrs)
        if tag not in VOID:
            self.handle_endtag(tag)

    def handle_data(self, data: str) -> None:
        self.builder.data(data)


@cache
def tree(report: str = "usual") -> ET.Element:
    cells: list[dict[str, object]] = [{"seed": 0, "aer": -100.0}, {"seed": 1, "aer": -104.0}]
    cloned = {"method": "bc", "run_id": "b", "k": None, "n": None}
    cells += [{"seed": seed, **cloned} for seed in range(10)]
    cells += [{"method": "dqn", "run_id": "c", **ALONE}, {"method": HOSTILE, "run_id": "d"}]
    if report == "empty":
        every = sample(tables=tuple(f"table{number}" for number in range(2, 10)))
        return Tree(page(replace(every, figures=[], runs=[], skipped=[], contradictions=[]))).root
    return Tree(page(sample(*cells))).root


def text(element: ET.Element | None) -> str:
    assert element is not None
    return " ".join("".join(element.itertext()).split())


def by_id(name: str, root: ET.Element | None = None) -> ET.Element:
    found = (tree() if root is None else root).findall(f".//*[@id='{name}']")
    assert len(found) == 1
    return found[0]


def labels(line: ET.Element) -> list[str]:
    return [text(head) for head in line.findall("th")]


Line = tuple[list[str], list[ET.Element]]


def lines(table: str, root: ET.Element | None = None) -> Iterator[Line]:
    """Labels and cells of each row of a table of the paper."""
    for line in by_id(table, root).iterfind(".//tbody/tr"):
        yield labels(line), line.findall("td")


def cells_of(table: str, *wanted: str) -> list[str]:
    [found] = [cells for names, cells in lines(table) if names == list(wanted)]
    return [text(cell) for cell in found]


def test_a_cell_has_ours_the_papers_the_verdict_and_the_reduction() -> None:
    assert cells_of("table2", "RIL", "AER")[2] == (
        "−102.00 ± 2.00 −104.00 … −100.00 paper −100.29 ± 1.59 ✓ matches · 2 seeds ◔ 2 of 10 seeds"
    )


def test_a_cell_with_all_seeds_has_no_sign_of_reduction() -> None:
    assert cells_of("table2", "BC", "AER")[2] == (
        "−105.00 ± 0.00 −105.00 … −105.00 paper −129.92 ± 4.14 ▲ better · 10 seeds"
    )


def test_a_cell_that_is_not_run_has_its_command() -> None:
    assert cells_of("table7", "Acrobot")[1] == (
        "paper −79.95 ○ not run ril-run env=acrobot method=ril ablation.k=1.5 copy"
    )


def test_a_cell_leads_to_its_run() -> None:
    [cell] = [cells[2] for names, cells in lines("table2") if names == ["RIL", "AER"]]
    assert [link.get("href") for link in cell.iter("a")] == ["#run-a"]


def test_the_headline_counts() -> None:
    answer = text(by_id("headline").find("p[@class='answer']"))
    assert answer == (
        "Of the 48 results on this page, 2 match, 1 is better, 0 are worse and 45 are not run."
    )


def test_the_headline_counts_reduced_runs() -> None:
    honest = by_id("headline").find("p[@class='honest']")
    assert text(honest).startswith(
        "Of the 3 results that have been run, 1 has the paper’s number of seeds and budget; 2 have "
    )


def test_the_bar_distinguishes_reduced_runs() -> None:
    bar = by_id("headline").find("div[@class='bar']")
    assert bar is not None
    assert [part.get("aria-label") for part in bar] == [
        "2 matches, fewer seeds or smaller budget",
        "1 better, full seeds and budget",
        "45 not run",
    ]


def test_the_matrices_add_up() -> None:
    by_method, by_table = by_id("headline").findall(".//table[@class='matrix']")
    assert [[text(cell) for cell in line] for line in by_table.iterfind("tbody/tr")] == [
        ["Table 2", "1", "1", "·", "18", "1 of 20"],
        ["Table 7", "1", "·", "·", "27", "0 of 28"],
    ]
    assert [[text(cell) for cell in line] for line in by_method.iterfind("tbody/tr")][:2] == [
        ["RIL", "2", "·", "·", "30", "0 of 32"],
        ["BC", "·", "1", "·", "3", "1 of 4"],
    ]


def test_the_list_has_every_number_that_counts() -> None:
    listed = by_id("numbers-table").findall("tbody/tr")
    assert len(listed) == 48
    [ours] = [line for line in listed if line.get("data-extent") == "full"]
    assert [text(cell) for cell in ours] == [
        "Table 2",
        "BC · AER · MountainCar",
        "−105.00 ± 0.00 (10)",
        "−105.00 … −105.00",
        "−129.92 ± 4.14",
        "▲ better",
        "",
    ]
    assert (ours.get("data-verdict"), ours.get("data-method")) == ("better", "BC")


def test_aggregates_have_their_intervals() -> None:
    table = by_id("performance").find(".//tbody")
    assert table is not None
    assert [[text(cell) for cell in line] for line in table] == [
        ["RIL", *["0.50 0.25 … −0.75"] * 4, "–"],
        ["BC", *["–"] * 4, "0.62 0.50 … 0.75"],
    ]


def test_a_run_has_its_provenance() -> None:
    assert [text(cell) for cell in by_id("run-a")] == [
        "a",
        "MountainCar",
        "ril",
        "0–1",
        "ril-run env=mountaincar copy",
        "today 0123456789ab",
        "Python 3",
    ]


def test_skipped_files_are_named() -> None:
    assert "a/results.csv: line 3: torn" in text(by_id("runs"))


def test_every_deviation_appears_once() -> None:
    numbers = [entry.number for each in documents(docs_folder()) for entry in each.entries]
    assert {"D1", "D17", "K1", "G4", "R3"} <= set(numbers)
    for number in numbers:
        assert text(by_id(number))


def test_what_is_not_ours_is_escaped() -> None:
    assert [names for names, _ in lines("table2")][-2:] == [[HOSTILE, "AER"], [HOSTILE, "P"]]
    assert len(list(tree().iter("script"))) == 1


@pytest.mark.parametrize("where", ["run", "skipped", "contradiction", "figure"])
def test_texts_are_escaped_wherever_they_stand(where: str) -> None:
    report = sample(tables=("table7",))
    match where:
        case "run":
            texts = dict.fromkeys(("command", "fault", "variant", "commit", "machine"), HOSTILE)
            report = replace(report, runs=[replace(RUN, run_id='"><script>', **texts)])
        case "skipped":
            report = replace(report, skipped=[HOSTILE])
        case "contradiction":
            report = replace(report, contradictions=[Contradiction(*[HOSTILE] * 4)])
        case "figure":
            report = replace(report, figures=[Drawn('"><script>', HOSTILE, HOSTILE, SVG)])
    root = Tree(page(report)).root
    assert len(list(root.iter("script"))) == 1
    assert HOSTILE in "".join(root.itertext())


def test_anchors_are_unique() -> None:
    anchors = [element.get("id") for element in tree().iter() if element.get("id")]
    assert len(anchors) == len(set(anchors))


def test_links_within_the_page_lead_somewhere() -> None:
    anchors = {element.get("id") for element in tree().iter()}
    links = [link.get("href", "") for link in tree().iter("a")]
    assert {link for link in links if "://" not in link and link[1:] not in anchors} == set()


def test_nothing_is_loaded() -> None:
    for element in tree().iter():
        assert not {"src", "srcset", "data", "poster", "action"} & set(element.keys())
        assert element.tag not in ("link", "iframe", "img", "object", "embed")
    [style] = [text(element) for element in tree().iter("style")]
    assert "url(" not in style
    assert "@import" not in style


def test_without_rows_every_cell_is_not_run_and_has_its_command() -> None:
    root = tree("empty")
    cells = [
        cell
        for number in range(2, 10)
        for _, across in lines(f"table{number}", root)
        for cell in across
        if cell.get("class") != "empty"
    ]
    assert len(cells) > 200
    for cell in cells:
        assert "not-run" in cell.get("class", "").split()
        assert text(cell.find(".//code")).startswith("ril-run ")


def test_without_rows_the_headline_says_so() -> None:
    answer = by_id("headline", tree("empty")).find("p[@class='answer']")
    assert text(answer) == "None of the 161 results on this page has been run yet."


def test_the_last_policies_are_said_to_be_the_last() -> None:
    root = Tree(page(replace(sample(), score="last"))).root
    assert "the last policy of each run" in text(by_id("headline", root))


def test_a_page_of_all_tables_speaks_of_the_paper() -> None:
    whole = [*sample(tables=("table7",)).tables] * 9
    root = Tree(page(replace(sample(), tables=whole))).root
    answer = by_id("headline", root).find("p[@class='answer']")
    assert text(answer).startswith("None of its 252 results ")


def test_a_figure_without_rows_says_so() -> None:
    report = replace(sample(), figures=[Drawn("figure4", "Box plots", "A box per method.", "")])
    assert "No rows to draw yet" in text(by_id("figure4", Tree(page(report)).root))
