"""Whatever a key accepts comes back from the row, and nothing is written that cannot be read."""

from __future__ import annotations

import dataclasses
import math
import tempfile
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from helpers.configurations import checked
from helpers.rows import ROW, row
from hypothesis import given, settings
from hypothesis import strategies as st

from ril.cli.configuration import from_file
from ril.io.errors import UserError, printable
from ril.io.numbers import LARGEST
from ril.io.rows import CurvePoint, Row, load_curves, load_results, write_csv
from ril.run.record import Record

some = settings(max_examples=min(20, settings.default.max_examples))
few = settings(max_examples=min(8, settings.default.max_examples))
WHOLE = st.one_of(st.integers(0, LARGEST), st.sampled_from([LARGEST, LARGEST - 1, 2**31, 2**52]))
FINITE = st.floats(allow_nan=False, allow_infinity=False)
TEXT = st.text(min_size=1, max_size=40).map(printable)
#: Values of each type of a column, as its annotation says.
VALUES: dict[str, st.SearchStrategy[Any]] = {
    "int": WHOLE,
    "int | None": st.none() | WHOLE,
    "float": FINITE,
    "float | None": st.none() | FINITE,
    "str": TEXT,
}
MAY_BE_EMPTY = ("variant", "commit")
COLUMNS = {name: VALUES[kind] for name, kind in Row.__annotations__.items()}
COLUMNS |= {name: COLUMNS[name] | st.just("") for name in MAY_BE_EMPTY}


@some
@given(values=st.fixed_dictionaries(COLUMNS))
def test_every_value_of_every_column_comes_back(values: dict[str, Any]) -> None:
    with tempfile.TemporaryDirectory() as folder:
        write_csv(Path(folder) / "results.csv", [Row(**values)])
        rows, left_out = load_results([Path(folder)])
    assert left_out == []
    [found] = rows.to_dict("records")
    for name, value in values.items():
        if value is None:
            assert math.isnan(found[name])
        else:
            assert (found[name], type(found[name])) == (value, type(found[name]))


#: Values of each type that do not come back.
LOST: dict[str, st.SearchStrategy[Any]] = {
    "int": st.integers(min_value=LARGEST + 1) | st.integers(max_value=-1),
    "int | None": st.integers(min_value=LARGEST + 1) | st.integers(max_value=-1),
    "float": st.sampled_from([math.nan, math.inf, -math.inf]),
    "float | None": st.sampled_from([math.inf, -math.inf]),
    "str": st.sampled_from(["a\nb", "a\rb", "a\x1fb", "a\0b", "a\udcffb", "x" * 10_001]),
}


@pytest.mark.parametrize("name", COLUMNS)
@few
@given(data=st.data())
def test_what_would_not_come_back_is_not_written(name: str, data: Any) -> None:
    kind = Row.__annotations__[name]
    value = data.draw(LOST[kind])
    if name == "performance" and value != value:
        value = math.inf  # NaN is a performance without a scale
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "results.csv"
        with pytest.raises(UserError) as refused:
            write_csv(path, [row(**{name: value})])
        assert not path.exists()
    assert f": {name} is " in str(refused.value)
    assert "\n" not in str(refused.value)


@some
@given(seed=WHOLE, epoch=WHOLE, samples=WHOLE, aer=FINITE)
def test_every_point_of_a_curve_comes_back(seed: int, epoch: int, samples: int, aer: float) -> None:
    with tempfile.TemporaryDirectory() as folder:
        point = CurvePoint(seed, epoch, samples, aer, {"loss": math.nan})
        write_csv(Path(folder) / "results.csv", [row(seed=seed)])
        write_csv(Path(folder) / "curve.csv", [point])
        curves, left_out = load_curves(load_results([Path(folder)])[0])
    assert left_out == []
    [found] = curves.drop(columns="run_id").to_dict("records")
    assert found == {"seed": seed, "epoch": epoch, "samples": samples, "aer": aer}


@pytest.mark.parametrize("aer", [math.nan, math.inf])
def test_a_point_that_would_not_come_back_is_not_written(tmp_path: Path, aer: float) -> None:
    with pytest.raises(UserError, match=r"curve\.csv: is not written: seed 3: aer is "):
        write_csv(tmp_path / "curve.csv", [CurvePoint(3, 1, 1, aer, {})])
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("aer", [math.nan, math.inf, -math.inf])
def test_a_mean_return_that_is_no_number_ends_a_run(aer: float) -> None:
    import torch

    record = Record([4, 5], torch.zeros(2, 1))
    with pytest.raises(UserError, match=r"^seed 5: the mean return after epoch 0 is "):
        record.evaluated(np.array([1.0, aer]), np.array([True, True]), {})


@pytest.mark.parametrize("text", ["9007199254740992", "9007199254740993", "1e16"])
@pytest.mark.parametrize("column", ["seed", "epochs", "total_timesteps", "trajectories"])
def test_a_number_that_would_be_read_as_another_is_left_out(
    tmp_path: Path, column: str, text: str
) -> None:
    write_csv(tmp_path / "results.csv", [ROW])
    header, line = (tmp_path / "results.csv").read_text().splitlines()
    cells = dict(zip(header.split(","), line.split(","), strict=True)) | {column: text}
    (tmp_path / "results.csv").write_text(f"{header}\n{','.join(cells.values())}\n")
    rows, [said] = load_results([tmp_path])
    assert rows.empty
    assert f"{column} is '{text}', must be a whole number from 0" in said


@pytest.mark.parametrize("performance", [math.nan, 0.5])
def test_a_scale_that_is_too_short_for_a_performance_leaves_it_empty(
    tmp_path: Path, performance: float
) -> None:
    short = {"random_return": 0.0, "expert_return_measured": 5e-324, "aer": 100.0}
    write_csv(tmp_path / "results.csv", [row(performance=performance, **short)])
    assert load_results([tmp_path])[1] == []


NAMES = st.text(st.characters(codec="utf-8"), min_size=1, max_size=30)


@some
@given(name=NAMES)
def test_a_name_of_an_environment_that_is_accepted_comes_back(name: str) -> None:
    try:
        config = checked("random", "env.name", name.replace("$", ""))
    except (UserError, ValueError):
        return
    with tempfile.TemporaryDirectory() as folder:
        write_csv(Path(folder) / "results.csv", [row(env=config.env.name)])
        rows, left_out = load_results([Path(folder)])
        assert (rows["env"].tolist(), left_out) == ([config.env.name], [])
        assert (Path(folder) / config.env.name).parent != Path(folder).parent


@pytest.mark.parametrize(
    "name", ["", ".", "./a", "a/", "a//b", "a/./b", "a\nb", "a\x1fb", "\u2028", "a\xa0b", "a\x85"]
)
def test_a_name_that_no_folder_and_no_row_has_is_refused(name: str) -> None:
    with pytest.raises(UserError, match=r"^env\.name="):
        checked("random", "env.name", name)


@pytest.mark.parametrize("key", ["method.epochs", "evaluation.episodes", "ablation.trajectories"])
@pytest.mark.parametrize("value", [LARGEST + 1, 2**64, 10**30])
def test_whole_numbers_that_no_table_holds_are_refused(key: str, value: int) -> None:
    with pytest.raises(UserError, match=rf"^{key}={value}: must be a whole number below 2\*\*53$"):
        checked("bc", key, value)


def test_the_largest_whole_number_is_accepted() -> None:
    assert checked("bc", "seeds", [LARGEST]).seeds == [LARGEST]


STRINGS = ["null", "1e5", "0x10", "true", "~", "é", " a ", "a: b", "[", "2020-01-01", "#", "''"]


@pytest.mark.parametrize("text", STRINGS)
def test_texts_of_a_configuration_come_back_from_its_file(tmp_path: Path, text: str) -> None:
    import yaml

    config = checked("random", "env.kwargs", {"value": text, text: [text, {"a": text}]})
    values = yaml.safe_dump(dataclasses.asdict(config), sort_keys=False, allow_unicode=True)
    (tmp_path / "config.yaml").write_text(values, encoding="utf-8")
    assert from_file(tmp_path / "config.yaml") == config
