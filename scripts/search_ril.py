"""Search a method's open choices one at a time, or several, on tuning seeds.

    python scripts/search_ril.py run ril mountaincar     # every choice without a row
    python scripts/search_ril.py try ril cartpole evaluation.every=1 method.episodes=2
    python scripts/search_ril.py show                    # tables as in docs/search/

Every choice runs with seeds 100 to 104, and trains on another trajectory of the expert than
reported runs. Each row is added to docs/search/<method>.csv as soon as it is known, so processes
for different methods or environments may run at the same time.
"""

from __future__ import annotations

import ril  # noqa: F401 - first, because it fixes the kernels of NumPy and torch

# isort: split

import csv
import fcntl
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from matched_dqn import composed
from rich.console import Console

from ril.cli.display import ConsoleDisplay
from ril.demonstrations.files import shipped_path
from ril.experts.collection import Episode, save
from ril.run.experiment import run as run_cell

SEARCH = Path(__file__).resolve().parents[1] / "docs" / "search"
SEEDS = "[100,101,102,103,104]"
ENVIRONMENTS = ("cartpole", "acrobot", "mountaincar", "lunarlander")
DEFAULT = "default"

#: Overrides of `ril-run` by method; each is a choice to try alone.
CHOICES = {
    "ril": (
        DEFAULT,
        "method.episodes=3",
        "method.goal_sampler.pre_steps_per_action=1000",
        "method.inverse_dynamics.inputs=states method.inverse_dynamics.standardize=true",
        "method.inverse_dynamics.standardize=true",
        "method.inverse_dynamics.standardize=change",
        "method.inverse_dynamics.updates=30",
        "method.inverse_dynamics.updates=1000",
        "method.inverse_dynamics.labels=sample",
        "method.cloning.updates=30",
        "method.cloning.updates=100",
        "method.cloning.updates=1000",
        "method.q_learning.updates=10",
        "method.q_learning.updates=50",
        "method.q_learning.discount=0.9",
        "method.q_learning.discount=0.99",
        "method.q_learning.target_interval=0",
        "method.q_learning.loss=mse",
        "method.exploration.kind=softmax",
        "method.goal_sampler.memory=epoch",
        "method.goal_sampler.keep_pre=true",
        "method.network.layer_norm=false",
        "method.network.attention=false",
        "evaluation.every=5",
        "fidelity=paper",
    ),
    "ril_consistent": (
        DEFAULT,
        "method.q_learning.imitation_weight=1",
        "method.q_learning.imitation_weight=0.05",
        "method.q_learning.temperature=0.03",
        "method.q_learning.temperature=0.3",
        "method.q_learning.gap=0.3",
        "method.q_learning.gap=3",
        "method.q_learning.n_steps=1",
        "method.q_learning.n_steps=10",
        "method.q_learning.min_confidence=0",
        "method.q_learning.min_confidence=0.8",
        "method.q_learning.anneal=false",
        "method.q_learning.replay_recent=null",
        "method.inverse_dynamics.learning_rate=5e-4",
        "method.q_learning.discount=0.9",
        "method.q_learning.updates=100",
        "method.q_learning.tau=0.002",
        "method.q_learning.learning_rate=5e-4",
        "method.episodes=2",
    ),
}


def tuning_demonstrations(env: str, folder: Path) -> Path:
    """Write an environment's trajectories without the first; the nearest in return leads them."""
    with np.load(shipped_path(env)) as arrays:
        lengths, terminated = arrays["lengths"], arrays["terminated"]
        states, ends = np.cumsum(lengths + 1)[:-1], np.cumsum(lengths)[:-1]
        parts = zip(
            np.split(arrays["observations"], states),
            np.split(arrays["actions"], ends),
            np.split(arrays["rewards"], ends),
            terminated.tolist(),
            strict=True,
        )
        first, *others = [Episode(0, *part) for part in parts]
    chosen = min(others, key=lambda episode: abs(episode.total_reward - first.total_reward))
    path = folder / f"{env}.npz"
    save(path, [chosen, *(episode for episode in others if episode is not chosen)])
    return path


def run(method: str, env: str, changed: str) -> None:
    """Run a method with some choices changed, unless they have a row."""
    path = SEARCH / f"{method}.csv"
    path.parent.mkdir(exist_ok=True)
    setting = {"changed": changed, "env": env}
    if not recorded(path, setting):
        overrides = () if changed == DEFAULT else changed.split()
        append(path, setting | outcome(env, f"method={method}", *overrides))


def outcome(env: str, *overrides: str) -> dict[str, Any]:
    """Run a cell on the tuning seeds and trajectory; return means over seeds by column."""
    display = ConsoleDisplay(Console(), live=False, alone=False)
    with tempfile.TemporaryDirectory() as folder:
        demonstrations = tuning_demonstrations(env, Path(folder))
        asked = (f"env={env}", f"seeds={SEEDS}", f"output_dir={folder}")
        config = composed(*asked, f"demonstrations={demonstrations}", *overrides)
        started = time.process_time()
        rows = pd.read_csv(run_cell(config, display) / "results.csv")
    return {
        "seeds": len(rows),
        "performance": rows["performance"].mean(),
        "aer": rows["aer"].mean(),
        "aer_std": rows["aer"].std(ddof=0),
        "worst": rows["aer"].min(),
        "aer_last": rows["aer_last"].mean(),
        "aer_last_std": rows["aer_last"].std(ddof=0),
        "samples_to_best": rows["samples_to_best"].mean(),
        "processor_seconds": time.process_time() - started,
        "commit": rows["commit"].iloc[0],
    }


def recorded(path: Path, setting: dict[str, Any]) -> bool:
    """Return whether a file has a row with these values."""
    return path.exists() and setting in pd.read_csv(path)[list(setting)].to_dict("records")


def append(path: Path, row: dict[str, Any]) -> None:
    """Add a row; the file is locked, since other processes may add theirs."""
    with path.open("a", newline="") as file:
        fcntl.flock(file, fcntl.LOCK_EX)
        writer = csv.DictWriter(file, row)
        if file.tell() == 0:
            writer.writeheader()
        rounded = {k: round(v, 3) if isinstance(v, float) else v for k, v in row.items()}
        writer.writerow(rounded)


def show() -> None:
    """Print a table per method: best (and last) returns by change and environment."""
    for name in ("ril_before", *CHOICES):
        path = SEARCH / f"{name}.csv"
        if not path.exists():
            continue
        tried = pd.read_csv(path)
        tried["cell"] = [
            f"{row.aer:.1f} ± {row.aer_std:.1f} ({row.aer_last:.1f})" for row in tried.itertuples()
        ]
        table = tried.pivot(index="changed", columns="env", values="cell")
        table = table.reindex(index=tried["changed"].unique(), columns=ENVIRONMENTS)
        table = table.dropna(axis="columns", how="all")
        print(f"\n### {name}\n")
        print(f"| changed | {' | '.join(table.columns)} |\n|---|{'---|' * len(table.columns)}")
        for changed, cells in table.fillna("–").iterrows():
            named = changed if changed == DEFAULT else f"`{changed}`"
            print(f"| {named} | {' | '.join(cells)} |")


if __name__ == "__main__":
    match sys.argv[1:]:
        case ["run", method, *environments] if method in CHOICES:
            for each in environments or ENVIRONMENTS:
                for changed in CHOICES[method]:
                    run(method, each, changed)
        case ["try", method, env, *overrides] if method in CHOICES and env in ENVIRONMENTS:
            run(method, env, " ".join(sorted(overrides)) or DEFAULT)
        case ["show"]:
            show()
        case _:
            sys.exit(__doc__)
