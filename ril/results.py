"""The rows a run leaves: their schema, written whole or not at all, and read back."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

import pandas as pd

from ril.errors import UserError
from ril.files import write_atomically


@dataclass(frozen=True)
class Row:
    """One seed of one run: a line of `results.csv`.

    Attributes:
        run_id: of the cell.
        env: name of the environment.
        method: name of the method.
        variant: keys that were set apart from the cell's own, "" for the method as it comes.
        seed: of the agent.
        k: eq. 2's slope; empty for methods without that equation.
        n: eq. 2's epochs; likewise.
        trajectories: expert trajectories learnt from; empty for methods that see none.
        expert_return: the level asked of a sub-optimal expert; empty for the usual one.
        epochs: trained, fewer than asked where the stopping rule ended the seed.
        total_timesteps: environment steps asked for; empty where epochs are the only budget.
        best_epoch: after which the best policy was found.
        aer: mean return of fresh episodes of the best policy.
        aer_std: standard deviation of these episodes' returns.
        aer_last: the same mean for the last policy.
        performance: (aer − random) / (expert − random) (§4).
        env_samples: steps of the policy's own training episodes (§5.2.2).
        expert_samples: expert transitions learnt from, counted once per epoch (§5.2.2).
        pre_samples: transitions of I^pre, which the paper does not count.
        samples_to_best: env_samples + expert_samples at the best policy's epoch.
        random_return: mean return of random actions, measured.
        expert_return_measured: mean return of all the expert's demonstrations.
        wall_seconds: of the whole run, all its seeds together.
        commit: of the code, "-dirty" with uncommitted changes; "" outside a checkout.
    """

    run_id: str
    env: str
    method: str
    variant: str
    seed: int
    k: float | None
    n: float | None
    trajectories: int | None
    expert_return: float | None
    epochs: int
    total_timesteps: int | None
    best_epoch: int
    aer: float
    aer_std: float
    aer_last: float
    performance: float
    env_samples: int
    expert_samples: int
    pre_samples: int
    samples_to_best: int
    random_return: float
    expert_return_measured: float
    wall_seconds: float
    commit: str


@dataclass(frozen=True)
class CurvePoint:
    """One seed at one evaluation during training: a line of `curve.csv`.

    Attributes:
        seed: of the agent.
        epoch: after which it was evaluated.
        samples: env_samples + expert_samples so far (§5.2.2).
        aer: mean return of the selection episodes.
        metrics: the method's own diagnostics of this epoch, each a column; see its page in docs/.
            Besides, of methods with pseudo-labels: `label_accuracy`, the share that equals the
            expert's true actions, which the method itself never sees.
    """

    seed: int
    epoch: int
    samples: int
    aer: float
    metrics: dict[str, float]


def write_csv(path: Path, lines: Sequence[Row] | Sequence[CurvePoint]) -> None:
    """Write rows or points under their field names."""
    plain = [asdict(line) for line in lines]
    for line in plain:
        line |= line.pop("metrics", {})
    write_atomically(path, pd.DataFrame(plain).to_csv(index=False).encode())


def load_results(folders: Sequence[Path]) -> pd.DataFrame:
    """All rows of all `results.csv` below some folders; the empty frame if there are none.

    Of a cell that was run again, the newest rows.

    Raises:
        UserError: a file does not hold rows.
    """
    files = {file for folder in folders for file in folder.rglob("results.csv")}
    columns = list(Row.__dataclass_fields__)
    frames = []
    for file in sorted(files, key=lambda file: (file.stat().st_mtime_ns, file)):
        try:  # hashes that happen to look like numbers (12345e6789) stay text
            frames.append(pd.read_csv(file, dtype={"run_id": str, "commit": str}))
        except (ValueError, UnicodeDecodeError):
            raise UserError(f"{file}: cannot be read as rows") from None
        if not {"run_id", "seed", "aer"} <= set(frames[-1].columns):
            raise UserError(f"{file}: holds no rows of ril")
    if not frames:
        return pd.DataFrame(columns=columns)
    rows = pd.concat([frame.reindex(columns=columns) for frame in frames], ignore_index=True)
    rows["variant"] = rows["variant"].astype(object).fillna("")
    return rows.drop_duplicates(["run_id", "seed"], keep="last", ignore_index=True)
