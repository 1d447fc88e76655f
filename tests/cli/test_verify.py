from __future__ import annotations

import json
import shutil
import sys
from collections.abc import Callable
from pathlib import Path

import pandas as pd
import pytest
from helpers.runs import Ended, Silence

from ril import kernels
from ril.cli.verify import main
from ril.run.experiment import run


@pytest.fixture(scope="module")
def finished(quick: Callable, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A finished run of IUPE with two seeds."""
    folder = tmp_path_factory.mktemp("finished")
    return run(quick("method=iupe", f"output_dir={folder}", "exact=true"), Silence())


@pytest.fixture
def kept(finished: Path, tmp_path: Path) -> Path:
    """A copy of it, which a test may change."""
    return Path(shutil.copytree(finished, tmp_path / "cartpole" / "iupe" / finished.name))


@pytest.fixture
def verify(
    monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> Callable[..., Ended]:
    def verified(*arguments: object) -> Ended:
        monkeypatch.setattr(sys, "argv", ["ril-verify", *map(str, arguments)])
        with pytest.raises(SystemExit) as end:
            main()
        said, status = capfd.readouterr(), end.value.code
        if isinstance(status, str):
            return Ended(1, said.out, f"{status}\n")
        return Ended(int(status or 0), said.out, said.err)

    return verified


Verify = Callable[..., Ended]


def changed(path: Path, line: int, column: str, value: object) -> None:
    """Change one value of a table."""
    table = pd.read_csv(path, dtype=str, keep_default_na=False)
    table.loc[line, column] = str(value)
    table.to_csv(path, index=False)


def test_a_run_repeats_in_every_digit(kept: Path, verify: Verify) -> None:
    before = sorted((file, file.stat().st_mtime_ns) for file in kept.rglob("*"))
    ended = verify(kept)
    assert f"{kept}: every digit agrees: 2 seeds, 4 evaluations during training" in ended.output
    assert ended.output.endswith("agree in every digit: 1 of 1 run\n")
    assert ended.status == 0
    assert sorted((file, file.stat().st_mtime_ns) for file in kept.rglob("*")) == before


def test_some_seeds_of_a_run_repeat_alone(kept: Path, verify: Verify) -> None:
    ended = verify(kept, "--seeds", 1)
    assert "every digit agrees: 1 seed, 2 evaluations during training" in ended.output
    assert ended.status == 0


def test_a_changed_digit_of_a_row_is_found(kept: Path, verify: Verify) -> None:
    changed(kept / "results.csv", 1, "aer_last", "9.1")
    ended = verify(kept)
    assert "differs: 1 of 2 seeds\n  seed 1: after training (aer_last)\n" in ended.output
    assert "agree in every digit: 0 of 1 run\n" in ended.output
    assert ended.status == 1


def test_the_first_epoch_that_differs_is_named(kept: Path, verify: Verify) -> None:
    curve = pd.read_csv(kept / "curve.csv", dtype=str)
    line = curve.index[(curve["seed"] == "0") & (curve["epoch"] == "3")][0]
    changed(kept / "curve.csv", line, "epsilon", "0.123")
    ended = verify(kept)
    assert "  seed 0: from epoch 3 on (only the curve)\n" in ended.output
    assert ended.status == 1


def test_another_version_is_a_reason(kept: Path, verify: Verify) -> None:
    path = kept / "provenance.json"
    provenance = json.loads(path.read_text())
    now = provenance["versions"]["numpy"]
    provenance["versions"]["numpy"], provenance["libc"] = "1.0", "musl 1"
    path.write_text(json.dumps(provenance))
    changed(kept / "results.csv", 0, "aer", "9.1")
    ended = verify(kept)
    assert f"  the run had numpy 1.0 (now {now})\n" in ended.output
    assert "  the run had libc musl 1 (now " in ended.output


def test_without_a_reason_it_says_so(kept: Path, verify: Verify) -> None:
    changed(kept / "results.csv", 0, "aer", "9.1")
    assert "\n  nothing that ril records explains it\n" in verify(kept).output


def test_samples_are_drawn_among_the_runs(kept: Path, tmp_path: Path, verify: Verify) -> None:
    shutil.copytree(kept, kept.with_name("0123456789"))
    ended = verify(tmp_path, "--sample", 1, "--seeds", 1)
    assert "agree in every digit: 1 of 1 run\n" in ended.output


def test_runs_that_are_not_exact_run_on_released_kernels(
    kept: Path, verify: Verify, monkeypatch: pytest.MonkeyPatch
) -> None:
    released: list[bool] = []
    monkeypatch.setattr(kernels, "release", lambda: released.append(True))
    config = kept / "config.yaml"
    config.write_text(config.read_text().replace("exact: true", "exact: false"))
    changed(kept / "results.csv", 0, "digits", "exact=false")
    changed(kept / "results.csv", 1, "digits", "exact=false")
    verify(kept)
    assert released == [True]


def test_changed_demonstrations_are_refused(kept: Path, verify: Verify) -> None:
    path = kept / "provenance.json"
    provenance = json.loads(path.read_text())
    provenance["demonstrations"]["sha256"] = "0"
    path.write_text(json.dumps(provenance))
    ended = verify(kept)
    assert ended.errors == f"ril-verify: {kept}: the demonstrations have changed since the run\n"


@pytest.mark.parametrize("name", ["provenance.json", "results.csv", "config.yaml"])
def test_torn_files_are_named(kept: Path, verify: Verify, name: str) -> None:
    (kept / name).write_bytes(b'{"a')
    ended = verify(kept)
    assert str(kept) in ended.errors
    assert ended.errors.count("\n") == 1
    assert ended.status == 1
