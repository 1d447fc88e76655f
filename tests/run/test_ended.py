"""Runs whose environment or whose learning fails: one line, every copy closed, no rows."""

from __future__ import annotations

import json
import signal
from collections.abc import Callable, Iterator
from contextlib import suppress
from pathlib import Path
from typing import Any

import pytest
import torch
from helpers.runs import QUICK_RUN, Silence, composed, quick_method
from helpers.strange import ID, Strange, registered, strange

from ril.cli.configuration import from_hydra
from ril.experts.collection import play, save
from ril.io.ended import load_ended
from ril.io.errors import UserError
from ril.methods.base import Progress
from ril.methods.registry import names
from ril.report.evidence import Evidence
from ril.run import training
from ril.run.experiment import run
from ril.run.record import Record

LEARNING = [name for name in names() if name not in ("random", "expert")]


@pytest.fixture(autouse=True)
def fresh() -> Iterator[None]:
    with registered():
        yield


@pytest.fixture(scope="module")
def expert(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("expert") / "strange.npz"
    with registered():
        save(path, play(strange(), lambda states: (states[:, 0] < 0).astype(int), range(3)))
    return path


Run = Callable[..., Path]


@pytest.fixture
def run_strange(expert: Path, tmp_path: Path) -> Run:
    def ran(
        how: str, *overrides: str, method: str = "dqn", after: int = 0, display: Any = None
    ) -> Path:
        given = (
            *(*QUICK_RUN, *quick_method(method), "env=gym", f"env.id={ID}", "ablation.n=4"),
            *(f"method={method}", f"demonstrations={expert}", "env.goal.minimum_return=0"),
            *(f"+env.kwargs.how='{how}'", f"+env.kwargs.after={after}", f"output_dir={tmp_path}"),
        )
        return run(from_hydra(composed(*given, *overrides)), display or Silence())

    return ran


def left_in(folder: Path) -> set[str]:
    return {path.name for path in folder.rglob("*") if path.is_file()}


@pytest.mark.parametrize("method", LEARNING)
def test_observations_that_turn_nan_end_a_run_of_any_method(
    run_strange: Run, tmp_path: Path, method: str
) -> None:
    """At a half and at the end of what a run without them asks; every copy is closed each time."""
    run_strange("NaN observation", method=method, after=10**9)
    calls = next(Strange.steps)
    assert set(Strange.made) == set(Strange.closed)
    [whole] = tmp_path.rglob("results.csv")
    whole.unlink()
    for after in (calls // 2, calls - 20):
        Strange.steps = iter(range(10**9))
        with pytest.raises(UserError, match=rf"^env.id={ID}: the observation\[0\] is nan.*rows$"):
            run_strange("NaN observation", method=method, after=after)
        assert set(Strange.made) == set(Strange.closed)
    assert "results.csv" not in left_in(tmp_path)
    assert "checkpoint.pt" not in left_in(tmp_path)


def test_an_ended_run_says_since_when_and_the_report_shows_it(
    run_strange: Run, tmp_path: Path
) -> None:
    with pytest.raises(UserError, match=r", in .*epoch \d+; the run ended without rows$") as told:
        run_strange("NaN reward", after=400)
    [ended], faults = load_ended([tmp_path])
    assert not faults
    assert f"ended: {str(told.value).removesuffix('; the run ended without rows')}" == ended.why
    assert (ended.method, ended.seeds, ended.trajectories) == ("dqn", [0, 1], None)
    assert Evidence.of([tmp_path]).ended == (ended,)


def test_a_later_run_of_the_same_cell_starts_from_scratch(
    run_strange: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(training, "CHECKPOINT_SECONDS", 0.0)
    with pytest.raises(UserError):
        run_strange("NaN observation", after=400)
    assert "checkpoint.pt" not in left_in(tmp_path)
    Strange.steps = iter(range(-(10**9), 0))  # its author has mended it
    folder = run_strange("NaN observation", after=400)
    assert left_in(folder) >= {"results.csv", "curve.csv"}
    assert "ended.json" not in left_in(folder)


class Spoils(Silence):
    """Makes a number of a method NaN after its first epoch."""

    def __init__(self, spoil: Callable[[], None]) -> None:
        self.spoil = spoil

    def advanced(self, progress: Progress, record: Record) -> None:
        self.spoil()


@pytest.mark.parametrize("method", LEARNING)
def test_parameters_that_diverge_end_a_run(
    quick: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, method: str
) -> None:
    config = from_hydra(composed(*QUICK_RUN, *quick_method(method), f"method={method}"))
    config.output_dir = str(tmp_path)
    built: list[Any] = []
    build = training.Run

    def kept(*arguments: Any) -> Any:
        built.append(build(*arguments))
        return built[-1]

    monkeypatch.setattr("ril.run.experiment.Run", kept)

    def spoil() -> None:
        trained = built[0].method
        networks = trained.learner.networks if method in ("ppo", "gail") else trained.policy
        networks.flat[1].fill_(torch.nan)

    with pytest.raises(UserError, match=r"not finite.* epoch 2; the run ended without rows$"):
        run(config, Spoils(spoil))
    assert "results.csv" not in left_in(tmp_path)
    [ended], _ = load_ended([tmp_path])
    assert "epoch 2" in ended.why


@pytest.mark.parametrize("how", ["raises", "is out of memory", "four values"])
def test_an_error_of_the_environment_is_one_line_and_not_an_end(
    run_strange: Run, tmp_path: Path, how: str
) -> None:
    """It may be mended, or gone when the run is resumed."""
    with pytest.raises(UserError, match=f"^env.id={ID}: step"):
        run_strange(how, after=400)
    assert not left_in(tmp_path) & {"ended.json", "results.csv"}


def test_a_doubt_is_told_and_kept(run_strange: Run) -> None:
    lines: list[str] = []

    class Told(Silence):
        def noted(self, line: str) -> None:
            lines.append(line)

    folder = run_strange("ignores its seed", display=Told())
    [doubt] = json.loads((folder / "provenance.json").read_text())["doubts"]
    assert doubt in lines
    assert "cannot be resumed exactly" in doubt


class Interrupts(Silence):
    """Sends this process a signal twice, or fails."""

    def __init__(self, number: int | None) -> None:
        self.number = number

    def advanced(self, progress: Progress, record: Record) -> None:
        if self.number is None:
            raise ZeroDivisionError
        signal.raise_signal(self.number)
        signal.raise_signal(self.number)


@pytest.mark.parametrize(
    ("how", "after", "number"),
    [
        ("raises", 400, 0),
        ("close raises", 0, 0),
        ("", 0, None),
        ("", 0, signal.SIGINT),
        ("", 0, signal.SIGTERM),
    ],
)
def test_every_copy_is_closed_whatever_ends_the_run(
    run_strange: Run, how: str, after: int, number: int | None
) -> None:
    display = Silence() if how else Interrupts(number)
    with suppress(UserError, ZeroDivisionError, KeyboardInterrupt):
        run_strange(how, after=after, display=display)
    assert Strange.made
    assert set(Strange.made) == set(Strange.closed)


def test_a_limit_of_a_billion_steps_is_refused_by_its_memory(run_strange: Run) -> None:
    with pytest.raises(UserError, match=r"max_episode_steps=1000000000000: random episodes need"):
        run_strange("", "+env.kwargs.max_episode_steps=1000000000000")


def test_a_limit_far_above_the_length_of_episodes_costs_no_memory(run_strange: Run) -> None:
    run_strange("", "+env.kwargs.max_episode_steps=1000000")


def test_running_out_of_memory_is_one_line(
    run_strange: Run, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refused(*_: Any) -> None:
        raise MemoryError("Unable to allocate 298. GiB")

    monkeypatch.setattr("ril.run.experiment.train_and_score", refused)
    with pytest.raises(UserError, match=r"^out of memory: Unable to allocate 298. GiB; fewer"):
        run_strange("")
