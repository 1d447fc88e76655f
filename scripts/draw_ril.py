"""RIL's open choices all at once: random draws, on seeds that no report uses.

    python scripts/draw_ril.py run 0 20 mountaincar acrobot   # draws 0 to 19 that have no row yet
    python scripts/draw_ril.py show                           # what each choice is worth

A draw is a setting of what the paper leaves open and may matter, the same on every environment;
not on LunarLander, where one takes a quarter of an hour. Seeds and trajectory are those of
search_ril.py. Rows go to docs/search/draws.csv, one as soon as it is known; several processes may
run at once.
"""

from __future__ import annotations

import sys
from typing import Any

import numpy as np
import pandas as pd
from search_ril import SEARCH, append, outcome, recorded

DRAWS = SEARCH / "draws.csv"

#: What a draw takes one of each of.
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
#: What else was so when the first draws were made.
AS_FIRST_DRAWN = ("evaluation.every=1", "method.inverse_dynamics.standardise=true")
BLOCK = 6  # a multiple of how many values each has
ENVIRONMENTS = ("cartpole", "acrobot", "mountaincar")


def drawn(draw: int) -> dict[str, Any]:
    """The settings of a draw; each six in a row have each value of a key equally often."""
    block, place = divmod(draw, BLOCK)
    generator = np.random.default_rng(block)
    return {
        key: values[generator.permutation(BLOCK)[place] % len(values)]
        for key, values in SPACE.items()
    }


def run(draw: int, env: str) -> None:
    """Run a draw, unless it has a row."""
    if recorded(DRAWS, {"draw": draw, "env": env}):
        return
    settings = drawn(draw)
    overrides = [f"{key}={value}" for key, value in settings.items()]
    measured = outcome(env, "method=ril", *AS_FIRST_DRAWN, *overrides)
    append(DRAWS, {"draw": draw, "env": env} | settings | measured)


def show() -> None:
    """Print the mean P of the draws with each choice ± its standard error, and the best draws."""
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
