"""CSV files, read into one table of typed columns; whatever is left out has its reason."""

from __future__ import annotations

import io
import os
import reprlib
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path

import numpy as np
import pandas as pd

from ril.io.numbers import LARGEST

LONGEST_TEXT = 10_000  # characters of a value; ours have at most some hundreds
#: What a value of a kind must be.
ALLOWED = {
    "int": "must be a whole number from 0",
    "float": "must be a finite number",
    "str": f"must have 1 to {LONGEST_TEXT:,} characters",
}
#: Ends each line as one more column; it is in another place if the line has columns too few or
#: too many.
_END = "\x1f"


class Faults:
    """What was left out of some files, and why."""

    def __init__(self) -> None:
        self._lines: dict[tuple[str, str], list[int]] = {}

    def add(self, file: str, line: int, why: str) -> None:
        """Record a line of a file that is left out; line 0 is the whole file."""
        self._lines.setdefault((file, why), []).append(line)

    @property
    def whole_files(self) -> set[str]:
        """The files that are left out as a whole."""
        return {file for (file, _), lines in self._lines.items() if 0 in lines}

    def messages(self) -> list[str]:
        """Return one message for each fault of a file, with the numbers of the lines it is in."""
        messages = []
        for (file, why), lines in self._lines.items():
            shown = ", ".join(map(str, lines[:3])) + (" …" if len(lines) > 3 else "")
            messages.append(f"{file}: {why}" if lines == [0] else f"{file}: line {shown}: {why}")
        return messages


def read_tables(
    files: Iterable[Path], kinds: Mapping[str, str], faults: Faults, *, more_columns: bool = False
) -> pd.DataFrame:
    """Read the valid lines of some CSV files.

    Args:
        files: the files to read, in order; files with the same header are parsed together.
        kinds: kind by wanted column, "int" (a count), "float" or "str", with " | None" if it may
            be empty.
        faults: records each file or line that is left out.
        more_columns: whether a file may have other columns.

    Returns:
        The wanted columns, `file`, and `line`, which counts from the header, line 1. Columns are
        int, float or object; empty numbers are NaN, empty texts "".
    """
    names: list[str] = []
    alike: dict[tuple[str, ...], list[tuple[int, str]]] = {}
    for number, file in enumerate(files):
        names.append(str(file))
        header, body = _content(file, list(kinds), faults, more_columns=more_columns)
        if body:
            alike.setdefault(tuple(header), []).append((number, body))
    tables = [pd.DataFrame(columns=[*kinds, "number", "line"], dtype=object)]
    for columns, bodies in alike.items():
        tables += _parsed(columns, bodies, list(kinds), names, faults)
    rows = pd.concat(tables).sort_values(["number", "line"], ignore_index=True)
    rows["file"] = pd.Series([names[number] for number in rows.pop("number")], dtype=object)

    why = pd.Series("", rows.index, dtype=object)
    for column, kind in kinds.items():
        text = rows[column]
        type_name, _, may_be_empty = kind.partition(" | ")
        if type_name == "str":
            fits = text.str.len().between(1, LONGEST_TEXT)
        else:
            rows[column] = value = pd.to_numeric(text, errors="coerce").astype(float)
            fits = value.abs() < np.inf
            if type_name == "int":
                fits &= value.between(0, LARGEST) & (value % 1 == 0)
        if may_be_empty:
            fits |= text == ""
        refused = f"{column} is " + text[~fits].map(reprlib.repr) + f", {ALLOWED[type_name]}"
        why[~fits & (why == "")] = refused
    for index in rows.index[why != ""]:
        seed = "" if why[index].startswith("seed ") else f"seed {rows['seed'][index]:.0f}: "
        faults.add(rows["file"][index], rows["line"][index], seed + why[index])
    whole = {column: int for column, kind in kinds.items() if kind == "int"}
    return rows[why == ""].astype({**whole, "line": int})


def _content(
    file: Path, columns: Sequence[str], faults: Faults, *, more_columns: bool
) -> tuple[list[str], str]:
    """Read a file's header and the complete lines below it; no lines if the file cannot be used."""
    why, text, body = "", "", ""
    header: list[str] = []
    try:
        if file.is_file():
            text = file.read_bytes().decode("utf-8-sig").replace("\r\n", "\n")
        else:
            why = "is not a file" if os.path.lexists(file) else "does not exist"
    except OSError as error:
        why = f"cannot be read ({error.strerror})"
    except UnicodeDecodeError:
        why = "is not UTF-8 text"
    if not why:
        first, _, body = text.partition("\n")
        header = first.split(",")
        why = _mismatch(header, columns, more_columns) if text.strip("\n") else "is empty"
    if not why and not body.strip("\n"):
        why = "has no rows"
    if why:
        faults.add(str(file), 0, why)
        return header, ""
    if not body.endswith("\n"):
        line = body.count("\n") + 2
        faults.add(str(file), line, "is incomplete: the file ends within it")
    return header, body[: body.rfind("\n") + 1]


def _mismatch(header: Sequence[str], columns: Sequence[str], more_columns: bool) -> str:
    """Return how a file's columns differ from the expected ones, "" if they do not."""
    problems = {
        "missing": [name for name in columns if name not in header],
        "unknown": [name for name in header if name not in columns and not more_columns],
        "repeated": [name for name in dict.fromkeys(header) if header.count(name) > 1],
    }
    for problem, names in problems.items():
        if names:
            more = f" and {len(names) - 3} more" if len(names) > 3 else ""
            return f"{problem} columns: {', '.join(map(reprlib.repr, names[:3]))}{more}"
    return ""


def _parsed(
    header: Sequence[str],
    bodies: Sequence[tuple[int, str]],
    columns: Sequence[str],
    names: Sequence[str],
    faults: Faults,
) -> list[pd.DataFrame]:
    """Parse files that have the same header.

    Args:
        header: their columns.
        bodies: for each file, its number in `names` and the lines below its header.
        columns: the wanted columns.
        names: the names of all files.
        faults: records each file or line that is left out.

    Returns:
        Tables of the wanted columns as text, with the `number` of the file and `line`.
    """
    numbers, texts = zip(*bodies, strict=True)
    lengths = [text.count("\n") for text in texts]
    wide = "," * len(header) + "\n"  # for the header: the parser counts columns in the first line
    try:
        table = pd.read_csv(
            io.StringIO(wide + "".join(texts).replace("\n", f",{_END}\n")),
            header=0,
            names=[*header, _END],
            usecols=[*columns, _END],  # with it, the parser accepts lines with more columns
            index_col=False,
            dtype=object,
            na_filter=False,
            lineterminator="\n",
            low_memory=False,
        )
    except pd.errors.ParserError:  # a quotation mark is open at the end
        table = pd.DataFrame()
    if len(table) != sum(lengths):  # or one was, and a line counts as part of the one before
        if len(bodies) > 1:
            alone = (_parsed(header, [body], columns, names, faults) for body in bodies)
            return [table for tables in alone for table in tables]
        faults.add(names[numbers[0]], 0, "has a line with an unclosed quotation mark")
        return []
    table["number"] = np.repeat(numbers, lengths)
    table["line"] = np.concatenate([np.arange(length) + 2 for length in lengths])
    complete = table.pop(_END) == _END
    for number, line in table.loc[~complete, ["number", "line"]].to_numpy():
        faults.add(names[number], int(line), f"does not have {len(header)} columns")
    return [table[complete]]
