"""Train RIL on MountainCar on a GPU and on the CPU: the same results, and what each costs.

    python scripts/check_gpu.py                  # some minutes; needs a torch that finds a GPU
    python scripts/check_gpu.py --device cpu     # the CPU beside itself, to try the script

Prints Markdown: seconds per epoch and seed for 1, 10, 100 and 1,000 seeds, the differences between
the devices, and the share of each part of an epoch. One CPU thread, `compile=false`.
"""

from __future__ import annotations

import ril  # noqa: F401 - first, because it fixes the kernels of NumPy and torch

# isort: split

import argparse
import sys
import time
from collections import defaultdict
from collections.abc import Callable
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

import hydra
import numpy as np
import torch
from numpy.typing import NDArray

from ril.cli.configuration import from_hydra, store_schemas
from ril.io.paths import config_folder
from ril.learners.cloning import Cloning
from ril.learners.imitation import SelfSupervisedImitation
from ril.methods.ril import EpisodicQLearning
from ril.run.prepare import prepare
from ril.vectorized.copies import ArrayCopies, GymnasiumCopies
from ril.vectorized.evaluation import Evaluation
from ril.vectorized.networks import Network
from ril.vectorized.streams import Streams

SEEDS = (1, 10, 100, 1000)
MOST_ON_CPU = 100  # 1,000 seeds take minutes there
EPOCHS = 4  # the first is not timed, the last is timed part by part
EPISODES = 20
#: Results of the first epoch, before the policies act, may differ by this share …
TOLERANCE = 0.01
#: … and mean returns after the last by so many standard errors.
STANDARD_ERRORS = 3

#: The functions whose time is measured, by part of an epoch.
PARTS: dict[str, list[tuple[type, str]]] = {
    "environments (CPU)": [
        (copies, name) for copies in (ArrayCopies, GymnasiumCopies) for name in ("step", "reset")
    ],
    "random numbers (CPU)": [(Streams, "uniform"), (Streams, "integers")],
    "goal sampler, I^pos": [
        (SelfSupervisedImitation, "sample_dataset"),
        (SelfSupervisedImitation, "remember"),
    ],
    "acting": [(Network, "infer")],
    "updates": [
        (SelfSupervisedImitation, "train"),
        (Cloning, "train"),
        (EpisodicQLearning, "train"),
    ],
}


@dataclass
class Measured:
    """A training of S seeds.

    Attributes:
        seconds: of one epoch, without the first.
        shares: of each part in the last epoch.
        first: results of the first epoch by name, each (S,).
        labels: (S, M) pseudo-labels of the first epoch.
        returns: (S,) mean returns after the last epoch.
        memory: bytes of the GPU's memory.
    """

    seconds: float
    shares: dict[str, float]
    first: dict[str, NDArray[np.float64]]
    labels: NDArray[np.int64]
    returns: NDArray[np.float64]
    memory: int


def synchronize(device: str) -> None:
    """Wait until the device has done what it was asked for."""
    if device != "cpu":
        torch.cuda.synchronize()


@contextmanager
def timed_parts(device: str, seconds: dict[str, float]) -> Any:
    """Add to `seconds` the time in each part, without that of the parts it calls."""
    originals = [
        (kind, name, getattr(kind, name)) for part in PARTS.values() for kind, name in part
    ]
    inner = [0.0]

    def wrapped(part: str, function: Callable[..., Any]) -> Callable[..., Any]:
        def call(*arguments: Any, **named: Any) -> Any:
            synchronize(device)
            inner.append(0.0)
            started = time.perf_counter()
            try:
                return function(*arguments, **named)
            finally:
                synchronize(device)
                whole = time.perf_counter() - started
                seconds[part] += whole - inner.pop()
                inner[-1] += whole

        return call

    for part, functions in PARTS.items():
        for kind, name in functions:
            setattr(kind, name, wrapped(part, getattr(kind, name)))
    try:
        yield
    finally:
        for kind, name, function in originals:
            setattr(kind, name, function)


def measure(device: str, seeds: int) -> Measured:
    """Train S seeds for some epochs on a device."""
    store_schemas()
    settings = [f"seeds={seeds}", f"device={device}", f"method.epochs={EPOCHS}", "compile=false"]
    with hydra.initialize_config_dir(str(config_folder()), version_base="1.3"):
        config = from_hydra(hydra.compose("config", ["env=mountaincar", "method=ril", *settings]))
    if device != "cpu":
        torch.cuda.reset_peak_memory_stats()
    cell = prepare(config)
    method = cell.build_method()
    assert method is not None
    training = method.train()
    first = next(training)
    synchronize(device)
    started = time.perf_counter()
    for _ in range(EPOCHS - 2):
        next(training)
    synchronize(device)
    seconds = (time.perf_counter() - started) / (EPOCHS - 2)
    parts: dict[str, float] = defaultdict(float)
    started = time.perf_counter()
    with timed_parts(device, parts):
        next(training)
    whole = time.perf_counter() - started
    parts["everything else"] = whole - sum(parts.values())
    returns = Evaluation(cell.environment, config.seeds).returns(method.policy, EPISODES, "check")
    metrics = {
        name: first.metrics[name] for name in ("inverse_dynamics_loss", "cloning_loss", "epsilon")
    }
    assert first.pseudo_labels is not None
    return Measured(
        seconds,
        {name: parts[name] / whole for name in (*PARTS, "everything else")},
        metrics,
        first.pseudo_labels,
        returns.mean(axis=1),
        torch.cuda.max_memory_allocated() if device != "cpu" else 0,
    )


def compare(here: Measured, there: Measured) -> tuple[str, bool]:
    """Describe how the results of two devices differ, and whether within the tolerance."""
    facts, fine = [], True
    for name in ("inverse_dynamics_loss", "cloning_loss"):
        difference = float(np.max(np.abs(there.first[name] / here.first[name] - 1)))
        facts.append(f"{name.replace('_', ' ')} differs by at most {difference:.1e}")
        fine &= difference <= TOLERANCE
    same = float((here.labels == there.labels).mean())
    facts.append(f"{same:.2%} of the pseudo-labels are equal")
    fine &= same >= 1 - TOLERANCE
    difference = here.returns.mean() - there.returns.mean()
    if len(here.returns) > 1:
        error = np.sqrt((here.returns.var() + there.returns.var()) / (len(here.returns) - 1))
        facts.append(f"mean returns differ by {difference:.2f}, standard error {error:.2f}")
        fine &= bool(abs(difference) <= STANDARD_ERRORS * error)
    return "; ".join(facts), fine


def main() -> None:
    """Measure and print; exit with status 1 if the devices' results differ."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--device", default="cuda", help="device beside the CPU (default: cuda)")
    parser.add_argument("--seeds", type=int, nargs="+", default=SEEDS, help="numbers of seeds")
    arguments = parser.parse_args()
    if arguments.device != "cpu" and not torch.cuda.is_available():
        sys.exit("check_gpu: torch finds no GPU here")
    torch.set_num_threads(1)
    if arguments.device != "cpu":
        print(f"{torch.cuda.get_device_name()}, torch {torch.__version__}\n")
    table = ["| seeds | CPU | GPU | GPU, per seed | CPU ÷ GPU | GPU memory |", "|" + "---|" * 6]
    lines, fine, last = [], True, None
    for seeds in arguments.seeds:
        there = last = measure(arguments.device, seeds)
        here = measure("cpu", seeds) if seeds <= MOST_ON_CPU else None
        known = f"{here.seconds:.2f} s" if here else "–"
        ratio = f"{here.seconds / there.seconds:.2f}×" if here else "–"
        per_seed = f"{there.seconds / seeds * 1000:.1f} ms"
        row = (f"{seeds:,}", known, f"{there.seconds:.2f} s", per_seed, ratio)
        table.append(f"| {' | '.join(row)} | {there.memory / 2**20:,.0f} MB |")
        print(table[-1], file=sys.stderr, flush=True)
        if here:
            said, within = compare(here, there)
            lines.append(f"- {seeds} seeds: {said}{'' if within else ': **not within tolerance**'}")
            fine &= within
    print("\n".join(table), "\n")
    print("\n".join(lines), "\n")
    assert last is not None
    print(f"| part of an epoch of {seeds:,} seeds on the GPU | share |\n|---|---|")
    for name, share in last.shares.items():
        print(f"| {name} | {share:.0%} |")
    sys.exit(not fine)


if __name__ == "__main__":
    main()
