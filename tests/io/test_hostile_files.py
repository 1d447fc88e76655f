"""Files that run code when read carelessly: every loader refuses or ignores that code."""

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

# tests/demonstrations and test_checkpoints.py have these tests for demonstrations and checkpoints.


class Bomb:
    """Makes a folder when it is unpickled."""

    def __init__(self, makes: Path) -> None:
        self.makes = makes

    def __reduce__(self) -> tuple[Any, ...]:
        return os.mkdir, (str(self.makes),)


@pytest.fixture
def exploded(tmp_path: Path) -> Path:
    return tmp_path / "exploded"


@pytest.fixture
def tag(exploded: Path) -> str:
    """YAML that makes a folder when an unsafe loader reads it."""
    return f'!!python/object/apply:os.mkdir ["{exploded}"]'


def test_careless_unpickling_sets_the_bomb_off(exploded: Path) -> None:
    pickle.loads(pickle.dumps(Bomb(exploded)))
    assert exploded.exists()


def test_careless_yaml_loading_sets_the_tag_off(exploded: Path, tag: str) -> None:
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
def test_a_policy_with_code_is_refused(
    tmp_path: Path, exploded: Path, pickled: Callable[[Bomb], bytes]
) -> None:
    path = tmp_path / "policy.pt"
    path.write_bytes(pickled(Bomb(exploded)))
    with pytest.raises(UserError, match=r"policy\.pt: not a policy that ril saved"):
        load_policy(path, 0)
    assert not exploded.exists()


def test_rows_with_code_are_refused(tmp_path: Path, exploded: Path) -> None:
    (tmp_path / "results.csv").write_bytes(pickle.dumps(Bomb(exploded)))
    rows, left_out = load_results([tmp_path])
    assert rows.empty
    assert "results.csv: " in left_out[0]
    assert not exploded.exists()


class InterruptsInTheThird(Silence):
    """A display that interrupts the run in its third epoch."""

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
    """Stop a run that has demonstrations of its own; returns its config and folder."""
    monkeypatch.setattr(training, "CHECKPOINT_SECONDS", 0.0)
    own = shutil.copy(demonstration_files["cartpole"], tmp_path / "own.npz")
    config = quick(f"demonstrations={own}")
    config.output_dir = str(tmp_path / "outputs")
    with pytest.raises(KeyboardInterrupt):
        run(config, InterruptsInTheThird())
    [checkpoint] = tmp_path.rglob("checkpoint.pt")
    return config, checkpoint.parent


@pytest.mark.parametrize("hostile", ["pickle", "deep", "tag"])
def test_provenance_with_code_is_refused(
    stopped: tuple[Config, Path], exploded: Path, tag: str, hostile: str
) -> None:
    config, folder = stopped
    contents = {
        "pickle": pickle.dumps(Bomb(exploded)),
        "deep": b"[" * 1_000_000,  # too deep for the parser
        "tag": tag.encode(),
    }
    (folder / "provenance.json").write_bytes(contents[hostile])
    with pytest.raises(UserError, match=r"provenance\.json: cannot be read"):
        run(config, Silence())
    assert not exploded.exists()


@pytest.mark.parametrize("hostile", ["tag", "deep"])
def test_code_in_a_stopped_runs_configuration_does_not_run(
    stopped: tuple[Config, Path], exploded: Path, tag: str, hostile: str
) -> None:
    config, folder = stopped
    text = f"demonstrations: {tag}" if hostile == "tag" else "[" * 100_000
    (folder / "config.yaml").write_text(text)
    assert config.demonstrations is not None
    # Only the demonstrations differ, so ril reads which file the stopped run used.
    with np.load(config.demonstrations) as archive:
        arrays = dict(archive)
    np.savez(config.demonstrations, **arrays | {"actions": 1 - arrays["actions"]})
    assert run(config, Silence()) != folder
    assert not exploded.exists()


def test_the_holders_name_is_shown_without_control_characters(tmp_path: Path) -> None:
    class NotNowError(Exception):
        """Ends the wait."""

    def wait(holder: str) -> None:
        raise NotNowError(holder)

    with claimed(tmp_path):
        (tmp_path / ".holder").write_text("\x1b[2J\x1b]0;title\x07 [bold]me\n")
        with pytest.raises(NotNowError) as said, claimed(tmp_path, wait=wait):
            pass
    assert str(said.value) == "[2J]0;title [bold]me"


def test_a_target_in_a_setting_is_not_instantiated(exploded: Path) -> None:
    target = f"+env.kwargs={{_target_:os.mkdir,path:{exploded}}}"
    assert composed(target).env.kwargs["_target_"] == "os.mkdir"
    assert not exploded.exists()


#: Functions that can run code from a file or code that a file names.
RUNS_CODE = {
    *("eval", "exec", "compile", "__import__", "import_module", "system", "run", "call"),
    *("instantiate", "get_method", "get_class", "get_object", "resolve_name"),
    *("unsafe_load", "full_load", "Unpickler", "read_pickle"),
}
#: Uses that are something else, or whose input does not come from a file.
ALLOWED = {
    ("methods/registry.py", "import_module"),  # names of its own table
    ("kernels.py", "system"),  # platform.system
    ("run/provenance.py", "run"),  # git
    ("run/provenance.py", "system"),  # platform.system
    ("cli/run.py", "run"),  # a cell
    ("run/verify.py", "run"),  # a cell
    ("run/loggers.py", "resolve_name"),  # a logger of the user's own, docs/logging.md
    ("vectorized/compiling.py", "compile"),  # torch.compile
    ("vectorized/compiling.py", "run"),  # the compiler's --version
}
SOURCES = sorted(Path(ril.__file__).parent.rglob("*.py"))


def calls(path: Path) -> Iterator[tuple[str, ast.Call]]:
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Call):
            yield ast.unparse(node.func), node


@pytest.mark.parametrize("path", SOURCES, ids=lambda path: path.stem)
def test_ril_calls_no_function_that_runs_code_from_a_file(path: Path) -> None:
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
        assert not called.startswith("pickle."), called
