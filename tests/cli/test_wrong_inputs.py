"""Each command of `wrong_inputs.md` is given, and must be answered as the page says."""

from __future__ import annotations

import re
import shlex
import sys
from collections.abc import Callable
from importlib.util import find_spec
from pathlib import Path

import numpy as np
import pytest
from helpers.runs import composed
from hydra.core.global_hydra import GlobalHydra

from ril.cli import expert as experts
from ril.cli import report, verify
from ril.cli import run as cli
from ril.cli.configuration import from_hydra
from ril.demonstrations.files import load_demonstrations, shipped_path
from ril.environments.environment import load_environment
from ril.experts import make
from ril.run.identity import run_folder
from ril.run.record import Record

PAGE = Path(__file__).parent / "wrong_inputs.md"
ROWS = re.findall(r"^\| `(ril-.*?)` \| ``?(.*?)``? \|$", PAGE.read_text("utf-8"), re.MULTILINE)
MAINS = {
    "ril-run": cli.main,
    "ril-report": report.main,
    "ril-expert": experts.main,
    "ril-verify": verify.main,
}


def test_the_page_has_at_least_forty_wrong_inputs() -> None:
    assert len(dict(ROWS)) == len(ROWS) >= 40


@pytest.fixture(scope="session")
def prepared(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with the files that the page lists."""
    folder = tmp_path_factory.mktemp("wrong_inputs")
    (folder / "file").touch()
    (folder / "empty").mkdir()
    (folder / "shadow" / "env").mkdir(parents=True)
    (folder / "shadow" / "env" / "mountaincar.yaml").write_text("id: Other-v0\n")
    (folder / "text.npz").write_text("no npz")
    cartpole = shipped_path("cartpole").read_bytes()
    (folder / "cartpole.npz").write_bytes(cartpole)
    (folder / "torn.npz").write_bytes(cartpole[:-100])
    with np.load(shipped_path("mountaincar")) as archive:
        arrays = dict(archive)
    np.savez(folder / "pickled.npz", **arrays | {"actions": arrays["actions"].astype(object)})
    arrays["observations"][7] = np.nan
    np.savez(folder / "nan.npz", **arrays)
    del arrays["actions"]
    np.savez(folder / "part.npz", **arrays)
    for name, file in (("rows", "results.csv"), ("stopped", "checkpoint.pt")):
        run = folder / run_folder(*_cell(f"output_dir={name}"))
        run.mkdir(parents=True)
        (run / file).write_bytes(b"torn")
    return folder


def _cell(override: str) -> tuple[object, str]:
    config = from_hydra(composed(override))
    environment = load_environment(config.env)
    return config, load_demonstrations(shipped_path("mountaincar"), environment).sha256


@pytest.fixture
def answer(
    prepared: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> Callable[[str], tuple[str, object]]:
    """What a command answers, and its exit status; it is an error if it trains."""

    def trained(*_: object, **__: object) -> None:
        raise AssertionError("it was not refused")

    monkeypatch.chdir(prepared)
    monkeypatch.setenv("HYDRA_FULL_ERROR", "0")  # the command sets it; put back after
    monkeypatch.setattr(Record, "advance", trained)
    monkeypatch.setattr(make, "train", trained)

    def answered(command: str) -> tuple[str, object]:
        monkeypatch.setattr(sys, "argv", shlex.split(command))
        GlobalHydra.instance().clear()
        with pytest.raises(SystemExit) as end:
            MAINS[sys.argv[0]]()
        said, status = capfd.readouterr(), end.value.code
        assert said.out == ""
        if isinstance(status, str):  # the interpreter prints it on stderr, and ends with 1
            return f"{said.err}{status}\n", 1
        return said.err, status

    return answered


@pytest.mark.parametrize(("command", "says"), ROWS)
def test_a_wrong_input_is_answered_as_the_page_says(
    answer: Callable[[str], tuple[str, object]], prepared: Path, command: str, says: str
) -> None:
    launcher = re.search(r"hydra/launcher=(ray|submitit)", command)
    if launcher and find_spec(f"hydra_plugins.hydra_{launcher[1]}_launcher"):
        pytest.skip("it is installed here")
    before = sorted(prepared.rglob("*"))
    text, status = answer(command)
    name = shlex.split(command)[0]
    said = re.sub(r"/[0-9a-f]{10}\b", "/0123456789", text.replace(f"{prepared}/", ""))
    # "…" stands for words of another library.
    expected = re.escape(f"{name}: {says}\n").replace("…", ".+")
    assert re.fullmatch(expected, said), said
    assert status == 1
    assert sorted(prepared.rglob("*")) == before
