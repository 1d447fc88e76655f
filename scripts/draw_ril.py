"""Search RIL's open choices by random draws, on tuning seeds that no report uses.

    python scripts/draw_ril.py run 0 20 mountaincar acrobot   # draws 0 to 19 without a row
    python scripts/draw_ril.py show                           # the effect of each choice

A draw sets every choice in SPACE, which the paper leaves open, to a random value. It is the same on
every environment. LunarLander is left out: a draw would take a quarter of an hour. Seeds and
trajectory are those of search_ril.py. Each row is added to docs/search/draws.csv as soon as it is
known, so several processes may run at the same time.
"""

from __future__ import annotations

import sys
from typing import Any

import numpy as np
import pandas as pd
from search_ril import SEARCH, append, outcome, recorded

DRAWS = SEARCH / "draws.csv"

#: Values of each choice; a draw has one of each.
SPACE: dict[str, tuple[Any, ...]] = {
    "method.q_learning.updates": (20, 50, 200),
    "method.q_learning.batch_size": (32, 128),
    "method.q_learning.discount": (0.9, 0.95, 0.99),
    "method.q_learning.target_interval": (0, 100, 500),
    "method.q_learning.loss": ("huber", "mse"),
    "method.cloning.updates": (100, 300),
    "method.inverse_dynamics.updates": (100, 300),
    "method.exploration.kind": ("softmax", "uniform"),
}
#: Defaults at the time of the first draws, so that later ones can be compared with them.
FIXED = ("evaluation.every=1", "method.inverse_dynamics.standardize=true")
BLOCK = 6  # draws; a multiple of each choice's number of values
ENVIRONMENTS = ("cartpole", "acrobot", "mountaincar")


def drawn(draw: int) -> dict[str, Any]:
    """Return the settings of a draw; a block of draws has each value of a key equally often."""
    block, place = divmod(draw, BLOCK)
    generator = np.random.default_rng(block)
    return {
        key: values[generator.permutation(BLOCK)[place] % len(values)]
        for key, values in SPACE.items()
    }


def run(draw: int, env: str) -> None:
    """Run a draw on an environment, unless it has a row."""
    if recorded(DRAWS, {"draw": draw, "env": env}):
        return
    settings = drawn(draw)
    overrides = [f"{key}={value}" for key, value in settings.items()]
    measured = outcome(env, "method=ril", *FIXED, *overrides)
    append(DRAWS, {"draw": draw, "env": env} | settings | measured)


def show() -> None:
    """Print the mean performance ± standard error by value of each choice, and the best draws."""
    rows = pd.read_csv(DRAWS)
    print(f"| | {' | '.join(ENVIRONMENTS)} |\n|---|{'---|' * len(ENVIRONMENTS)}")
    for key, values in SPACE.items():
        for value in values:
            chosen = rows[rows[key] == value].groupby("env")["performance"]
            mean, error = chosen.mean(), chosen.sem()
            cells = [
                f"{mean.get(e, np.nan):.3f} ± {error.get(e, np.nan):.3f}" for e in ENVIRONMENTS
            ]
            print(f"| `{key}={value}` | {' | '.join(cells)} |")
    table = rows.pivot(index="draw", columns="env", values="performance").dropna()
    print("\n", table.assign(mean=table.mean(axis=1)).sort_values("mean", ascending=False))


if __name__ == "__main__":
    match sys.argv[1:]:
        case ["run", first, end, *environments]:
            for draw in range(int(first), int(end)):
                for env in environments or ENVIRONMENTS:
                    run(draw, env)
        case ["show"]:
            show()
        case _:
            sys.exit(__doc__)
