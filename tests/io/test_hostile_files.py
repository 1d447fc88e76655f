"""Files that would run code if they were read carelessly; each loader refuses or ignores it."""

from __future__ import annotations

import ast
import io
import os
import pickle
import shutil
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
import yaml
from helpers.runs import Silence, composed

import ril
from ril.config.schema import Config
from ril.io.errors import UserError
from ril.io.locks import claimed
from ril.io.rows import load_results
from ril.methods.base import Progress
from ril.policy import load_policy
from ril.run import training
from ril.run.experiment import run
from ril.run.record import Record

# Of demonstrations and checkpoints the like is in tests/demonstrations and test_checkpoints.py.


class Bomb:
    """What makes a folder when it is unpickled."""

    def __init__(self, makes: Path) -> None:
        self.makes = makes

    def __reduce__(self) -> tuple[Any, ...]:
        return os.mkdir, (str(self.makes),)


@pytest.fixture
def exploded(tmp_path: Path) -> Path:
    return tmp_path / "exploded"


@pytest.fixture
def tag(exploded: Path) -> str:
    """YAML that makes a folder when it is not read safely."""
    return f'!!python/object/apply:os.mkdir ["{exploded}"]'


def test_the_bomb_would_go_off(exploded: Path) -> None:
    pickle.loads(pickle.dumps(Bomb(exploded)))
    assert exploded.exists()


def test_the_tag_would_go_off(exploded: Path, tag: str) -> None:
    yaml.unsafe_load(tag)
    assert exploded.exists()


def zipped(bomb: Bomb) -> bytes:
    buffer = io.BytesIO()
    torch.save({"seeds": [0], "best": bomb}, buffer)
    return buffer.getvalue()


def legacy(bomb: Bomb) -> bytes:
    buffer = io.BytesIO()
    torch.save({"seeds": [0], "best": bomb}, buffer, _use_new_zipfile_serialization=False)
    return buffer.getvalue()


@pytest.mark.parametrize("pickled", [zipped, legacy, pickle.dumps])
def test_a_policy_that_would_run_code_is_refused(
    tmp_path: Path, exploded: Path, pickled: Callable[[Bomb], bytes]
) -> None:
    path = tmp_path / "policy.pt"
    path.write_bytes(pickled(Bomb(exploded)))
    with pytest.raises(UserError, match=r"policy\.pt: not a policy that ril saved"):
        load_policy(path, 0)
    assert not exploded.exists()


def test_rows_that_would_run_code_are_refused(tmp_path: Path, exploded: Path) -> None:
    (tmp_path / "results.csv").write_bytes(pickle.dumps(Bomb(exploded)))
    rows, left_out = load_results([tmp_path])
    assert rows.empty
    assert "results.csv: " in left_out[0]
    assert not exploded.exists()


class StopsAfterTwo(Silence):
    """Interrupts a run in its third epoch."""

    def advanced(self, progress: Progress, record: Record) -> None:
        if progress.epoch == 3:
            raise KeyboardInterrupt


@pytest.fixture
def stopped(
    quick: Any,
    tmp_path: Path,
    demonstration_files: dict[str, Path],
    monkeypatch: pytest.MonkeyPatch,
) -> tuple[Config, Path]:
    """A run with demonstrations of its own that was stopped, and its folder."""
    monkeypatch.setattr(training, "CHECKPOINT_SECONDS", 0.0)
    own = shutil.copy(demonstration_files["cartpole"], tmp_path / "own.npz")
    config = quick(f"demonstrations={own}")
    config.output_dir = str(tmp_path / "outputs")
    with pytest.raises(KeyboardInterrupt):
        run(config, StopsAfterTwo())
    [checkpoint] = tmp_path.rglob("checkpoint.pt")
    return config, checkpoint.parent


@pytest.mark.parametrize("hostile", ["pickle", "deep", "tag"])
def test_provenance_that_would_run_code_is_refused(
    stopped: tuple[Config, Path], exploded: Path, tag: str, hostile: str
) -> None:
    config, folder = stopped
    contents = {
        "pickle": pickle.dumps(Bomb(exploded)),
        "deep": b"[" * 1_000_000,  # as deep as makes Python give up
        "tag": tag.encode(),
    }
    (folder / "provenance.json").write_bytes(contents[hostile])
    with pytest.raises(UserError, match=r"provenance\.json: cannot be read"):
        run(config, Silence())
    assert not exploded.exists()


@pytest.mark.parametrize("hostile", ["tag", "deep"])
def test_a_stopped_runs_configuration_that_would_run_code_does_not(
    stopped: tuple[Config, Path], exploded: Path, tag: str, hostile: str
) -> None:
    config, folder = stopped
    text = f"demonstrations: {tag}" if hostile == "tag" else "[" * 100_000
    (folder / "config.yaml").write_text(text)
    assert config.demonstrations is not None
    # The run would be the stopped one but for these, so it is asked which file that had.
    with np.load(config.demonstrations) as archive:
        arrays = dict(archive)
    np.savez(config.demonstrations, **arrays | {"actions": 1 - arrays["actions"]})
    assert run(config, Silence()) != folder
    assert not exploded.exists()


def test_who_is_said_to_hold_a_folder_is_shown_as_text(tmp_path: Path) -> None:
    class NotNowError(Exception):
        """Ends the waiting."""

    def wait(holder: str) -> None:
        raise NotNowError(holder)

    with claimed(tmp_path):
        (tmp_path / ".lock").write_text("\x1b[2J\x1b]0;title\x07 [bold]me\n")
        with pytest.raises(NotNowError) as said, claimed(tmp_path, wait=wait):
            pass
    assert str(said.value) == "[2J]0;title [bold]me"


def test_a_target_in_a_setting_is_a_value_like_any_other(exploded: Path) -> None:
    target = f"+env.kwargs={{_target_:os.mkdir,path:{exploded}}}"
    assert composed(target).env.kwargs["_target_"] == "os.mkdir"
    assert not exploded.exists()


#: What can run code that a file names or holds, by the function's last name.
RUNS_CODE = {
    *("eval", "exec", "compile", "__import__", "import_module", "system", "run", "call"),
    *("instantiate", "get_method", "get_class", "get_object", "resolve_name"),
    *("unsafe_load", "full_load", "Unpickler", "read_pickle"),
}
#: Where they stand for something else, or what they are given is not a file's.
ALLOWED = {
    ("methods/registry.py", "import_module"),  # names of its own table
    ("provenance.py", "run"),  # git
    ("provenance.py", "system"),  # platform.system
    ("cli.py", "run"),  # a cell
    ("loggers.py", "resolve_name"),  # a logger of the user's own, docs/logging.md
    ("vectorized/compiling.py", "compile"),  # torch.compile
}
SOURCES = sorted(Path(ril.__file__).parent.rglob("*.py"))


def calls(path: Path) -> Iterator[tuple[str, ast.Call]]:
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Call):
            yield ast.unparse(node.func), node


@pytest.mark.parametrize("path", SOURCES, ids=lambda path: path.stem)
def test_no_code_of_ours_runs_what_a_file_says(path: Path) -> None:
    name = path.relative_to(SOURCES[0].parent).as_posix()
    for called, node in calls(path):
        last = called.rpartition(".")[2]
        options = {option.arg: ast.unparse(option.value) for option in node.keywords}
        assert last not in RUNS_CODE or (name, last) in ALLOWED or called == "re.compile", called
        if called == "torch.load":
            assert options["weights_only"] == "True"
        if called == "np.load":
            assert options["allow_pickle"] == "False"
        if called.startswith("yaml."):
            assert last.startswith("safe_") or "Safe" in called or "BaseLoader" in ast.unparse(node)
        if called.startswith("pickle."):
            assert name == "vectorized/processes.py"  # between a run and its own workers
