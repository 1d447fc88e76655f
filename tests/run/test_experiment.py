from __future__ import annotations

import dataclasses
import json
import signal
from collections.abc import Callable
from importlib.metadata import version
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pandas as pd
import pytest
import torch
import yaml
from helpers.runs import Silence

from ril.config.schema import Config
from ril.demonstrations.files import load_demonstrations, shipped_path
from ril.environments.environment import Environment
from ril.io.errors import UserError
from ril.io.rows import Row
from ril.methods.base import Progress
from ril.policy import load_policy
from ril.run import training
from ril.run.experiment import run
from ril.run.record import Record
from ril.run.verify import OF_THE_RUN
from ril.vectorized.evaluation import random_returns
from ril.vectorized.streams import Streams

QuickRun = Callable[..., Path]


@pytest.fixture(scope="module")
def quick_run(quick: Any, tmp_path_factory: pytest.TempPathFactory) -> QuickRun:
    """Run the quick configuration with overrides; gives the run's folder."""

    def ran(*overrides: str, folder: Path | None = None, display: Any = None) -> Path:
        config = quick(*overrides)
        config.output_dir = str(folder or tmp_path_factory.mktemp("outputs"))
        return run(config, display or Silence())

    return ran


def table(folder: Path, name: str) -> pd.DataFrame:
    return pd.read_csv(folder / name, dtype={"run_id": str})


def rows(folder: Path) -> list[dict[str, Any]]:
    """The rows of `results.csv` without the run's name, time and code."""
    return table(folder, "results.csv").drop(columns=OF_THE_RUN).to_dict("records")


def rows_of(seed: int, folder: Path) -> str:
    return repr([row for row in rows(folder) if row["seed"] == seed])


def curve_of(seed: int, folder: Path) -> str:
    curve = table(folder, "curve.csv")
    return str(curve[curve["seed"] == seed].to_csv(index=False))


@pytest.fixture(scope="module")
def finished(quick_run: QuickRun) -> Path:
    return quick_run()


def test_a_run_leaves_its_files_and_nothing_else(finished: Path) -> None:
    assert sorted(path.name for path in finished.iterdir()) == [
        "config.yaml",
        "curve.csv",
        "policy.pt",
        "provenance.json",
        "results.csv",
    ]


def test_results_have_a_row_per_seed(finished: Path) -> None:
    assert table(finished, "results.csv")["seed"].tolist() == [0, 1]


def test_results_have_the_columns_of_a_row(finished: Path) -> None:
    columns = [field.name for field in dataclasses.fields(Row)]
    assert table(finished, "results.csv").columns.tolist() == columns


def test_the_folder_is_named_after_the_run(finished: Path) -> None:
    assert set(table(finished, "results.csv")["run_id"]) == {finished.name}
    assert [parent.name for parent in finished.parents][:2] == ["ril", "cartpole"]


def test_the_curve_has_every_other_epoch_and_the_last(finished: Path) -> None:
    assert table(finished, "curve.csv")["epoch"].tolist() == [2, 2, 3, 3]


def test_the_configuration_is_kept(finished: Path, quick: Any) -> None:
    kept = yaml.safe_load((finished / "config.yaml").read_text())
    expected = dataclasses.asdict(quick())
    assert kept | {"output_dir": None} == expected | {"output_dir": None}


def test_provenance_names_the_run_and_its_demonstrations(
    finished: Path, demonstration_files: dict[str, Path], cartpole: Environment
) -> None:
    kept = json.loads((finished / "provenance.json").read_text())
    expected = load_demonstrations(demonstration_files["cartpole"], cartpole).sha256
    assert kept["run_id"] == finished.name
    assert kept["demonstrations"] == {"file": "cartpole.npz", "sha256": expected}
    assert kept["versions"]["torch"] == version("torch")


def test_rows_say_that_compiling_was_impossible(
    monkeypatch: pytest.MonkeyPatch, quick: Any
) -> None:
    monkeypatch.setenv("CXX", "missing")
    rows = table(run(quick("compile=true"), Silence()), "results.csv")
    assert rows["digits"].str.startswith("not compiled: no C++ compiler found (missing)").all()
    assert (table(run(quick("seeds=[7]"), Silence()), "results.csv")["digits"] == "exact").all()


def test_rows_of_a_resumed_run_say_that_its_start_was_not_compiled(
    monkeypatch: pytest.MonkeyPatch,
    quick_run: QuickRun,
    checkpoints_every_epoch: None,
    tmp_path: Path,
) -> None:
    monkeypatch.setenv("CXX", "missing")
    with pytest.raises(KeyboardInterrupt):
        quick_run(*LONGER, "compile=true", folder=tmp_path, display=Interrupt(2))
    monkeypatch.delenv("CXX")
    folder = quick_run(*LONGER, "compile=true", folder=tmp_path)
    assert table(folder, "results.csv")["digits"].str.startswith("not compiled: no C++").all()


def plain_returns(folder: Path, seed: int, which: str, episodes: int) -> list[float]:
    """Returns of a saved policy on the fresh episodes of a result, by a plain Gymnasium loop."""
    policy, copy = load_policy(folder / "policy.pt", seed, which), gym.make("CartPole-v1")
    [starts] = Streams([seed], "evaluation of the result").integers(2**31, episodes)
    returns = []
    for start in starts:
        observation, _ = copy.reset(seed=int(start))
        total, over = 0.0, False
        while not over:
            action = int(policy.predict(observation))
            observation, reward, terminated, truncated, _ = copy.step(action)
            total, over = total + float(reward), terminated or truncated
        returns.append(total)
    return returns


@pytest.mark.parametrize(("column", "which"), [("aer", "best"), ("aer_last", "last")])
def test_saved_policies_earn_what_the_rows_say(finished: Path, column: str, which: str) -> None:
    for row in rows(finished):
        returns = plain_returns(finished, row["seed"], which, episodes=3)
        assert row[column] == np.mean(returns)


def test_spread_is_that_of_the_best_policys_episodes(finished: Path) -> None:
    for row in rows(finished):
        returns = plain_returns(finished, row["seed"], "best", episodes=3)
        assert row["aer_std"] == pytest.approx(np.std(returns))


def test_performance_is_zero_at_random_and_one_at_the_expert(
    finished: Path, demonstration_files: dict[str, Path], cartpole: Environment
) -> None:
    expert = load_demonstrations(demonstration_files["cartpole"], cartpole).returns.mean()
    random = random_returns(cartpole, [0], 3).mean()
    for row in rows(finished):
        assert row["expert_return_measured"] == pytest.approx(expert)
        assert row["random_return"] == random
        assert row["performance"] == pytest.approx((row["aer"] - random) / (expert - random))


def test_the_best_epoch_is_the_best_of_the_curve(finished: Path) -> None:
    curve = table(finished, "curve.csv")
    for row in rows(finished):
        points = curve[curve["seed"] == row["seed"]]
        best = points.loc[points["aer"].idxmax()]
        assert (row["best_epoch"], row["samples_to_best"]) == (best["epoch"], best["samples"])


def test_samples_are_counted_as_the_paper_does(
    finished: Path, demonstration_files: dict[str, Path], cartpole: Environment
) -> None:
    lengths = load_demonstrations(demonstration_files["cartpole"], cartpole).lengths
    curve = table(finished, "curve.csv")
    for row in rows(finished):
        assert row["expert_samples"] == 3 * lengths[0]  # its one trajectory once per epoch
        assert row["pre_samples"] == 2 * 60  # the random transitions, not among the samples
        last = curve[curve["seed"] == row["seed"]].iloc[-1]
        assert last["samples"] == row["env_samples"] + row["expert_samples"]


def test_label_accuracy_compares_with_the_experts_actions(
    quick_run: QuickRun, tmp_path: Path, demonstration_files: dict[str, Path]
) -> None:
    with np.load(demonstration_files["cartpole"]) as archive:
        arrays = dict(archive)
    flipped = tmp_path / "flipped.npz"
    np.savez(flipped, **arrays | {"actions": 1 - arrays["actions"]})
    as_given = table(quick_run(), "curve.csv")["label_accuracy"]
    as_flipped = table(quick_run(f"demonstrations={flipped}"), "curve.csv")["label_accuracy"]
    np.testing.assert_allclose(as_given + as_flipped, 1)


def test_true_actions_change_nothing_but_their_accuracy(
    quick_run: QuickRun,
    finished: Path,
    tmp_path: Path,
    demonstration_files: dict[str, Path],
) -> None:
    with np.load(demonstration_files["cartpole"]) as archive:
        arrays = dict(archive)
    zeros = tmp_path / "zeros.npz"
    np.savez(zeros, **arrays | {"actions": 0 * arrays["actions"]})
    assert repr(rows(quick_run(f"demonstrations={zeros}"))) == repr(rows(finished))


def same(one: Path, other: Path) -> bool:
    """Whether two runs left the same rows, curves and policies."""
    policies = [torch.load(folder / "policy.pt", weights_only=True) for folder in (one, other)]
    return (
        repr(rows(one)) == repr(rows(other))
        and (one / "curve.csv").read_text() == (other / "curve.csv").read_text()
        and all(torch.equal(policies[0][name], policies[1][name]) for name in ("best", "last"))
    )


def test_the_same_run_twice_gives_the_same(quick_run: QuickRun, finished: Path) -> None:
    assert same(quick_run(), finished)


def test_other_seeds_give_another(quick_run: QuickRun, finished: Path) -> None:
    assert not same(quick_run("seeds=[5,6]"), finished)


MOUNTAINCAR = ("env=mountaincar", "env.goal.minimum_return=null")


@pytest.mark.parametrize("overrides", [(), MOUNTAINCAR])
def test_a_seeds_results_do_not_depend_on_other_seeds(
    quick_run: QuickRun, overrides: tuple[str, ...]
) -> None:
    alone = quick_run("seeds=[5]", *overrides)
    among = quick_run("seeds=[3,5,9]", *overrides)
    assert rows_of(5, among) == rows_of(5, alone)
    assert curve_of(5, among) == curve_of(5, alone)


# So the seeds stop after different epochs (4, 4 and 10), not all of which are evaluated anyway.
STOPPING = (
    "method.epochs=14",
    "evaluation.every=3",
    "method.stopping.patience=3",
    "method.stopping.loss_tolerance=0",
    "method.cloning.learning_rate=0.003",
    "method.cloning.updates=10",
)


@pytest.fixture(scope="module")
def stopped(quick_run: QuickRun) -> Path:
    return quick_run("seeds=[3,5,9]", *STOPPING)


def test_seeds_stop_by_themselves(stopped: Path) -> None:
    epochs = table(stopped, "results.csv")["epochs"]
    assert epochs.nunique() > 1
    assert epochs.min() < 14
    assert epochs.min() % 3 != 0


def test_a_stopped_seeds_curve_ends_where_it_stopped(stopped: Path) -> None:
    curve = table(stopped, "curve.csv")
    ends = curve.groupby("seed")["epoch"].max().to_dict()
    assert ends == {row["seed"]: row["epochs"] for row in rows(stopped)}


@pytest.mark.parametrize("seed", [3, 5, 9])
def test_a_stopped_seeds_results_do_not_depend_on_other_seeds(
    quick_run: QuickRun, stopped: Path, seed: int
) -> None:
    alone = quick_run(f"seeds=[{seed}]", *STOPPING)
    assert rows_of(seed, alone) == rows_of(seed, stopped)
    assert curve_of(seed, alone) == curve_of(seed, stopped)


class Interrupt(Silence):
    """Interrupts a run in the epoch it is given, as Ctrl-C would."""

    def __init__(self, epoch: int) -> None:
        self.epoch = epoch

    def advanced(self, progress: Progress, record: Record) -> None:
        if progress.epoch == self.epoch:
            raise KeyboardInterrupt


LONGER = ("method.epochs=6", "ablation.n=5")


@pytest.fixture
def checkpoints_every_epoch(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(training, "CHECKPOINT_SECONDS", 0.0)


@pytest.fixture
def interrupted(quick_run: QuickRun, checkpoints_every_epoch: None, tmp_path: Path) -> Path:
    """The folder of a run that was stopped in its fifth epoch, four of them in its checkpoint."""
    with pytest.raises(KeyboardInterrupt):
        quick_run(*LONGER, folder=tmp_path, display=Interrupt(5))
    [checkpoint] = tmp_path.rglob("checkpoint.pt")
    return checkpoint.parent


class Epochs(Silence):
    """Remembers which epochs were trained."""

    def __init__(self) -> None:
        self.seen: list[int] = []

    def advanced(self, progress: Progress, record: Record) -> None:
        self.seen.append(progress.epoch)


def test_an_interrupted_run_has_no_rows_yet(interrupted: Path) -> None:
    assert sorted(path.name for path in interrupted.iterdir()) == [
        "checkpoint.pt",
        "config.yaml",
        "provenance.json",
    ]


def test_an_interrupted_run_resumes_from_its_checkpoint(
    quick_run: QuickRun, interrupted: Path, tmp_path: Path
) -> None:
    epochs = Epochs()
    assert quick_run(*LONGER, folder=tmp_path, display=epochs) == interrupted
    assert epochs.seen == [5, 6]


@pytest.mark.quick
@pytest.mark.parametrize(
    "overrides", [(), ("method.stopping.patience=3", "method.goal_sampler.memory=epoch")]
)
def test_a_resumed_run_leaves_what_an_uninterrupted_one_does(
    quick_run: QuickRun, checkpoints_every_epoch: None, tmp_path: Path, overrides: tuple[str, ...]
) -> None:
    for epoch in (2, 5):
        with pytest.raises(KeyboardInterrupt):
            quick_run(*LONGER, *overrides, folder=tmp_path, display=Interrupt(epoch))
    resumed = quick_run(*LONGER, *overrides, folder=tmp_path)
    assert same(resumed, quick_run(*LONGER, *overrides))
    assert not (resumed / "checkpoint.pt").exists()


def test_the_provenance_of_a_resumed_run_is_that_of_its_first_start(
    quick_run: QuickRun, interrupted: Path, tmp_path: Path
) -> None:
    first = json.loads((interrupted / "provenance.json").read_text())
    quick_run(*LONGER, folder=tmp_path)
    after = json.loads((interrupted / "provenance.json").read_text())
    again = {"command", "started", "commit", "processor", "digits"}
    assert [set(each) for each in after.pop("resumed")] == [again]
    assert after == first


class Signal(Silence):
    """Sends this process a signal in its second epoch."""

    def __init__(self, number: int) -> None:
        self.number = number

    def advanced(self, progress: Progress, record: Record) -> None:
        if progress.epoch == 2:
            signal.raise_signal(self.number)


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
def test_a_signal_stops_after_the_epoch_and_nothing_is_lost(
    quick_run: QuickRun, tmp_path: Path, number: int
) -> None:
    handler = signal.getsignal(number)
    with pytest.raises(KeyboardInterrupt, match="stopped after epoch 2; resume with "):
        quick_run(*LONGER, folder=tmp_path, display=Signal(number))
    assert signal.getsignal(number) is handler
    epochs = Epochs()
    assert same(quick_run(*LONGER, folder=tmp_path, display=epochs), quick_run(*LONGER))
    assert epochs.seen == [3, 4, 5, 6]


class SignalWhileScoring(Silence):
    """Sends this process a signal once training is over."""

    def scoring(self) -> None:
        signal.raise_signal(signal.SIGTERM)


def test_a_signal_while_scoring_stops_at_once_and_training_is_kept(
    quick_run: QuickRun, tmp_path: Path
) -> None:
    with pytest.raises(KeyboardInterrupt, match="stopped immediately; resume with "):
        quick_run(*LONGER, folder=tmp_path, display=SignalWhileScoring())
    epochs = Epochs()
    assert same(quick_run(*LONGER, folder=tmp_path, display=epochs), quick_run(*LONGER))
    assert epochs.seen == []


class ClosedTerminal(Silence):
    """Fails as a terminal that is closed after the first epoch, and sends SIGHUP as it does."""

    def advanced(self, progress: Progress, record: Record) -> None:
        if progress.epoch == 2:
            signal.raise_signal(signal.SIGHUP)
            raise OSError("Input/output error")


def test_a_closed_terminal_does_not_cost_the_epoch(quick_run: QuickRun, tmp_path: Path) -> None:
    with pytest.raises(KeyboardInterrupt, match="stopped after epoch 2; resume with "):
        quick_run(*LONGER, folder=tmp_path, display=ClosedTerminal())
    epochs = Epochs()
    quick_run(*LONGER, folder=tmp_path, display=epochs)
    assert epochs.seen == [3, 4, 5, 6]


def test_a_torn_checkpoint_is_one_clear_mistake(
    quick_run: QuickRun, interrupted: Path, tmp_path: Path
) -> None:
    checkpoint = interrupted / "checkpoint.pt"
    checkpoint.write_bytes(checkpoint.read_bytes()[:-9])
    with pytest.raises(UserError, match=r"checkpoint\.pt: cannot be read .*; delete it") as refused:
        quick_run(*LONGER, folder=tmp_path)
    assert str(checkpoint) in str(refused.value)
    assert "\n" not in str(refused.value)


def test_without_resume_a_checkpoint_is_left_alone(
    quick_run: QuickRun, interrupted: Path, tmp_path: Path
) -> None:
    epochs = Epochs()
    again = quick_run(*LONGER, "resume=false", folder=tmp_path, display=epochs)
    assert epochs.seen == [1, 2, 3, 4, 5, 6]
    assert again != interrupted
    assert (interrupted / "checkpoint.pt").exists()


def test_without_resume_no_checkpoint_is_left_that_nothing_could_resume(
    quick_run: QuickRun, checkpoints_every_epoch: None, tmp_path: Path
) -> None:
    with pytest.raises(KeyboardInterrupt, match=r"^stopped after epoch 2$"):
        quick_run(*LONGER, "resume=false", folder=tmp_path, display=Signal(signal.SIGINT))
    assert not list(tmp_path.rglob("checkpoint.pt"))


class Finished(Silence):
    """Remembers whether a run said that it was skipped."""

    skipped: bool | None = None

    def advanced(self, progress: Progress, record: Record) -> None:
        raise AssertionError("trained again")

    def finished(self, rows: Path, *, skipped: bool) -> None:
        self.skipped = skipped


def test_a_finished_run_is_not_run_again(quick_run: QuickRun, finished: Path) -> None:
    outputs, display = finished.parents[2], Finished()
    before = (finished / "results.csv").read_text()
    assert quick_run(folder=outputs, display=display) == finished
    assert display.skipped is True
    assert (finished / "results.csv").read_text() == before


def test_without_resume_a_finished_run_is_run_beside_it(
    quick_run: QuickRun, tmp_path: Path
) -> None:
    folders = [quick_run("resume=false", folder=tmp_path) for _ in range(3)]
    names = [folders[0].name, f"{folders[0].name}-2", f"{folders[0].name}-3"]
    assert [folder.name for folder in folders] == names
    assert same(folders[0], folders[1])


def test_one_more_epoch_is_another_run(quick_run: QuickRun, finished: Path) -> None:
    longer = quick_run("method.epochs=4", folder=finished.parents[2])
    assert longer.name != finished.name


def test_an_expert_no_better_than_random_gives_no_performance(
    quick_run: QuickRun, tmp_path: Path
) -> None:
    # In MountainCar this one trajectory and all random ones return −200.
    np.savez(
        tmp_path / "still.npz",
        observations=np.tile(np.array([[-0.5, 0.0]], dtype=np.float32), (201, 1)),
        actions=np.ones(200, dtype=np.int64),
        rewards=np.full(200, -1.0, dtype=np.float32),
        lengths=np.array([200]),
    )
    found = rows(quick_run(*MOUNTAINCAR, f"demonstrations={tmp_path / 'still.npz'}", "seeds=1"))
    assert np.isnan(found[0]["performance"])


def reference(method: str, compose: Any, output: Path, *overrides: str) -> Path:
    config = compose(f"method={method}", "seeds=[4,9]", "evaluation.episodes=30", *overrides)
    config.output_dir = str(output)
    return run(config, Silence())


def test_random_rows_are_of_each_seeds_random_play(
    compose: Any, tmp_path: Path, cartpole: Environment
) -> None:
    found = rows(reference("random", compose, tmp_path, "env=cartpole"))
    returns = random_returns(cartpole, [4, 9], 30)
    assert [row["aer"] for row in found] == returns.mean(axis=1).tolist()
    assert [row["aer_last"] for row in found] == returns.mean(axis=1).tolist()
    assert [row["aer_std"] for row in found] == pytest.approx(returns.std(axis=1))


def test_expert_rows_are_of_all_of_its_trajectories(
    compose: Any, tmp_path: Path, cartpole: Environment
) -> None:
    level = "ablation.expert_return=400"
    found = rows(reference("expert", compose, tmp_path, "env=cartpole", level))
    returns = load_demonstrations(shipped_path("cartpole_400"), cartpole).returns
    for row in found:
        assert row["aer"] == pytest.approx(returns.mean())
        assert row["aer_std"] == pytest.approx(returns.std())
        assert row["performance"] == 1
        assert row["expert_return"] == 400


@pytest.mark.parametrize("method", ["random", "expert"])
def test_a_reference_leaves_rows_and_where_they_come_from(
    compose: Any, tmp_path: Path, method: str
) -> None:
    folder = reference(method, compose, tmp_path)
    names = sorted(path.name for path in folder.iterdir())
    assert names == ["config.yaml", "provenance.json", "results.csv"]
    for row in rows(folder):
        counts = ("epochs", "env_samples", "expert_samples", "pre_samples", "samples_to_best")
        assert [row[name] for name in counts] == [0] * 5


class SignalAtStart(Silence):
    """Sends this process a signal before anything is done."""

    def started(self, config: Config, folder: Path, epochs: int) -> None:
        signal.raise_signal(signal.SIGTERM)


def test_a_signal_ends_a_reference_at_once(compose: Any, tmp_path: Path) -> None:
    config = compose("method=random", "seeds=1")
    config.output_dir = str(tmp_path)
    with pytest.raises(KeyboardInterrupt, match="stopped immediately; resume with "):
        run(config, SignalAtStart())
    assert not list(tmp_path.rglob("results.csv"))


@pytest.mark.parametrize(("method", "used"), [("ril", True), ("bc", False), ("iupe", False)])
def test_rows_have_equation_2_where_it_is_used(
    quick_run: QuickRun, method: str, used: bool
) -> None:
    for row in rows(quick_run(f"method={method}", "ablation.k=3")):
        assert (row["k"] == 3) is used
        assert bool(np.isnan(row["n"])) is not used


def refused(config: Config, output: Path) -> str:
    config.output_dir = str(output)
    with pytest.raises(UserError) as caught:
        run(config, Silence())
    assert not output.exists() or not list(output.rglob("*"))
    return str(caught.value)


def test_demonstrations_that_do_not_ship_are_named(compose: Any, tmp_path: Path) -> None:
    says = refused(compose("env=gym", "env.id=MountainCar-v0"), tmp_path)
    assert says.startswith("demonstrations=null: ")
    assert says.endswith("MountainCar-v0; give demonstrations=PATH")


def test_an_expert_level_that_does_not_ship_is_named(compose: Any, tmp_path: Path) -> None:
    says = refused(compose("ablation.expert_return=-1"), tmp_path)
    assert says.startswith("ablation.expert_return=-1: ")
    assert "mountaincar_-140" in says


def test_demonstrations_of_another_level_are_refused(
    compose: Any, tmp_path: Path, cartpole: Environment
) -> None:
    path = shipped_path("cartpole_400")
    given = ("env=cartpole", f"demonstrations={path}")
    says = refused(compose(*given, "ablation.expert_return=300"), tmp_path)
    assert says.startswith("ablation.expert_return=300: ")
    assert f"demonstrations={path} is 400.40" in says


@pytest.mark.parametrize("device", ["nonsense", "cuda:99", "meta", "", "cpu:x"])
def test_a_device_that_cannot_be_used_is_named(compose: Any, tmp_path: Path, device: str) -> None:
    config = compose()
    config.device = device
    assert refused(config, tmp_path).startswith(f"device={device}: ")


def test_a_method_that_is_not_known_is_named(compose: Any, tmp_path: Path) -> None:
    config = compose()
    config.method.name = "foo"
    assert refused(config, tmp_path).startswith("method.name=foo: must be one of acktr, bc, ")


@pytest.mark.parametrize("below", ["", "deeper/still"])
def test_a_folder_that_cannot_be_written_is_named(compose: Any, tmp_path: Path, below: str) -> None:
    (tmp_path / "file").touch()
    says = refused(compose(), tmp_path / "file" / below if below else tmp_path / "file")
    assert says.startswith("output_dir: ")
    assert str(tmp_path / "file") in says
