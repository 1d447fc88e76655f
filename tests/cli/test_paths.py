"""Paths that a sweep's planner and its cells must take for the same."""

from __future__ import annotations

import errno
import os
from collections.abc import Callable
from pathlib import Path

import pytest
from helpers.runs import Ended, composed
from omegaconf import OmegaConf

from ril.cli.arguments import folder_of
from ril.cli.configuration import from_hydra
from ril.cli.sweep import _fixed, plan
from ril.io import files
from ril.io.files import WriteError, write_atomically
from ril.io.locks import claimed

Here = Callable[..., Ended]
RANDOM = ("env=cartpole", "method=random", "evaluation.episodes=2", "seeds=1,2")
BASIC = ("-m", "hydra/launcher=basic", *RANDOM)


@pytest.fixture(autouse=True)
def home(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    folder = tmp_path / "home"
    monkeypatch.setenv("HOME", str(folder))
    return folder


@pytest.mark.parametrize(
    ("overrides", "pattern"),
    [
        (("output_dir=${hydra:runtime.cwd}/x",), "x/*/*/*"),
        (("output_dir=x/${now:%M%S%f}",), "x/*/*/*/*"),
        (("output_dir=x/${hydra:job.num}",), "x/[01]/*/*/*"),
        (('output_dir="~/x"',), "home/x/*/*/*"),
        (("output_dir=x", "hydra.job.chdir=true"), "x/*/*/*"),
        (
            ("output_dir=x", "hydra.job.chdir=true", "hydra.sweep.subdir=${hydra:job.num}"),
            "x/c*/*/*",
        ),
        (("output_dir=x,y",), "[xy]/*/*/*"),
    ],
)
def test_planner_and_cells_agree_on_the_folder(
    here: Here, tmp_path: Path, overrides: tuple[str, ...], pattern: str
) -> None:
    command = (*BASIC, *overrides)
    ended = here(*command)
    assert (ended.status, ended.errors) == (0, "")
    cells = 4 if "output_dir=x,y" in overrides else 2
    assert f"{cells} of {cells} cells finished" in ended.output
    found = sorted(tmp_path.rglob("results.csv"))
    assert len(found) == cells
    assert found == sorted(path / "results.csv" for path in tmp_path.glob(pattern))
    assert not (tmp_path / "~").exists()
    if "job.num" in command[-1]:
        assert f"{cells} already finished\n" in here(*command).output


@pytest.mark.parametrize("flags", [(), ("hydra.job.chdir=true", "hydra.run.dir=elsewhere")])
def test_a_single_run_takes_paths_from_where_it_was_started(
    here: Here, tmp_path: Path, flags: tuple[str, ...]
) -> None:
    ended = here("env=cartpole", "method=random", "evaluation.episodes=2", "output_dir=x", *flags)
    assert (ended.status, ended.errors) == (0, "")
    [found] = tmp_path.rglob("results.csv")
    assert found.is_relative_to(tmp_path / "x")


def test_demonstrations_are_found_from_another_folder(
    here: Here, tmp_path: Path, demonstration_files: dict[str, Path]
) -> None:
    (tmp_path / "mine.npz").write_bytes(demonstration_files["cartpole"].read_bytes())
    ended = here(*BASIC, "demonstrations=mine.npz", "output_dir=x", "hydra.job.chdir=true")
    assert (ended.status, ended.errors) == (0, "")


@pytest.mark.parametrize("key", ["output_dir", "demonstrations"])
def test_the_home_folder_is_put_in(home: Path, key: str) -> None:
    given = composed("method=random").copy()
    OmegaConf.update(given, key, "~/x")
    assert getattr(from_hydra(given), key) == f"{home}/x"
    OmegaConf.update(given, key, "./~/x")
    assert getattr(from_hydra(given), key) == "./~/x"


def test_arguments_of_other_commands_have_the_home_folder(home: Path) -> None:
    assert folder_of("~/x") == home / "x"
    assert folder_of("./~/x") == Path("~/x")


def test_the_command_of_a_cell_has_the_values_of_the_plan(tmp_path: Path) -> None:
    hydra = {"sweeper": {"sweeps": None}, "runtime": {"config_sources": [], "cwd": str(tmp_path)}}

    def compose(job: list[str]) -> object:
        found = composed("method=random").copy()
        OmegaConf.update(found, "hydra", hydra, force_add=True)
        found.output_dir = "${hydra:runtime.cwd}/it's"
        found.seeds = ["${oc.decode:${now:%Y}}"]
        return found

    jobs = [["method=random", "output_dir=$\\{hydra\\:runtime.cwd\\}", "seeds=[$\\{now\\:%Y\\}]"]]
    [cell] = plan(jobs, compose, OmegaConf.create({"hydra": hydra}))  # type: ignore[arg-type]
    assert cell.config is not None
    assert cell.overrides == [
        "method=random",
        f'output_dir="{tmp_path}/it\'s"',
        f"seeds=[{cell.config.seeds[0]}]",
    ]


def test_a_key_that_is_given_twice_is_given_to_the_cell_twice() -> None:
    given = ["+env.kwargs.a=1", "env.kwargs.a=2", "method=random"]
    assert _fixed(given, composed("method=random")) == given


@pytest.mark.parametrize("number", [errno.EINVAL, errno.ENOTSUP, errno.ENOSYS])
@pytest.mark.parametrize("what", ["folders", "everything"])
def test_a_file_system_that_cannot_flush_is_no_obstacle(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, number: int, what: str
) -> None:
    fsync = os.fsync

    def refuse(opened: int) -> None:
        if what == "everything" or Path(f"/proc/self/fd/{opened}").is_dir():
            raise OSError(number, os.strerror(number))
        fsync(opened)

    monkeypatch.setattr(files.os, "fsync", refuse)
    write_atomically(tmp_path / "file", b"whole")
    assert [path.name for path in tmp_path.iterdir()] == ["file"]
    assert (tmp_path / "file").read_bytes() == b"whole"


@pytest.mark.parametrize("number", [errno.EIO, errno.ENOSPC, errno.EROFS, errno.EDQUOT])
def test_a_flush_that_fails_for_another_reason_is_an_error(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, number: int
) -> None:
    def refuse(_: int) -> None:
        raise OSError(number, os.strerror(number))

    (tmp_path / "file").write_bytes(b"old")
    monkeypatch.setattr(files.os, "fsync", refuse)
    with pytest.raises(WriteError, match=os.strerror(number)):
        write_atomically(tmp_path / "file", b"new")
    assert (tmp_path / "file").read_bytes() == b"old"


@pytest.mark.parametrize("number", [errno.EACCES, errno.EISDIR, errno.ENOTSUP])
def test_a_folder_that_cannot_be_opened_is_no_obstacle(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, number: int
) -> None:
    def refuse(*_: object) -> int:
        raise OSError(number, os.strerror(number))

    monkeypatch.setattr(files.os, "open", refuse)
    write_atomically(tmp_path / "file", b"whole")
    assert (tmp_path / "file").read_bytes() == b"whole"


@pytest.mark.parametrize("number", [errno.EINVAL, errno.ENOTSUP, errno.ENOLCK, errno.ENOSYS])
def test_a_file_system_without_locks_is_told_and_used(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, number: int
) -> None:
    def refuse(*_: object) -> None:
        raise OSError(number, os.strerror(number))

    monkeypatch.setattr("fcntl.flock", refuse)
    with claimed(tmp_path / "cell") as claim:
        assert not claim.exclusive
        claim.check()
