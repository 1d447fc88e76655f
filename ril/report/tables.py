"""The paper's tables with our rows beside them, as Markdown."""

from __future__ import annotations

import pandas as pd

from ril.report.paper import (
    ENVIRONMENTS,
    WITHOUT_EXPERT,
    in_setting,
    method_named,
    number,
    paper,
    shortfall,
)

TUNING_SEEDS = 100  # settings are chosen on seeds from here up, which are not reported on


def results_table(rows: pd.DataFrame, table: str) -> str:
    """A table of returns by method and environment: ours, the paper's, and what is left to run.

    Args:
        rows: as `results.load_results` returns them.
        table: "table2", "table4" or "table5".
    """
    reported = paper()[table]
    lines = [
        f"**{reported['caption']}**: average episodic reward (AER) and performance P,",
        "mean ± standard deviation over seeds.",
        "",
        "| | | " + " | ".join(ENVIRONMENTS.values()) + " | Average P |",
        "|---" * (len(ENVIRONMENTS) + 3) + "|",
    ]
    notes: list[str] = []
    for method, by_paper in reported["returns"].items():
        of_method = rows[(rows["method"] == method_named(method)) & (rows["seed"] < TUNING_SEEDS)]
        candidates = of_method[in_setting(of_method, table)]
        aer, performance, means, missing = [], [], [], []
        for env, title in ENVIRONMENTS.items():
            in_env = candidates[candidates["env"] == env]
            notes += _left_out(of_method, method, env, title)
            if in_env.empty:
                aer.append("not run")
                performance.append("–")
                missing.append(env)
                continue
            cell = fullest_cell(in_env)
            seeds = "1 seed" if len(cell) == 1 else f"{len(cell)} seeds"
            aer.append(f"{_spread(cell['aer'], 2)} ({seeds})")
            performance.append(_spread(cell["performance"], 3))
            means.append(cell["performance"].mean())
            if short := shortfall(cell, table, method):
                notes.append(f"- {method} on {title} was run with {' and '.join(short)}")
            shown, runs = cell["run_id"].nunique(), in_env["run_id"].nunique()
            if shown < runs:
                notes.append(f"- {method} on {title}: {shown} of {runs} runs shown, the fullest")
        if missing:
            notes.append(_not_run(method, missing, reported["setting"]["trajectories"]))
        average = f"{sum(means) / 4:.3f}" if len(means) == 4 else "–"
        by_environment = [number(by_paper[env]) for env in ENVIRONMENTS]
        paper_average = number(reported["average_performance"][method])
        lines += [
            f"| **{method}** | AER, ours | " + " | ".join(aer) + " | |",
            "| | AER, paper | " + " | ".join(by_environment) + " | |",
            "| | P, ours | " + " | ".join(performance) + f" | {average} |",
            "| | P, paper | " + " | " * 4 + f"{paper_average} |",
        ]
    return "\n".join(lines + (["", *notes] if notes else []))


def _left_out(of_method: pd.DataFrame, method: str, env: str, title: str) -> list[str]:
    """A line on runs of a cell that are not the method as it comes."""
    apart = (of_method["env"] == env) & (of_method["variant"] != "")
    count = of_method.loc[apart, "run_id"].nunique()
    runs = "1 run" if count == 1 else f"{count} runs"
    return [f"- {method} on {title}: {runs} with keys set apart left out"] if count else []


def _not_run(method: str, environments: list[str], trajectories: int) -> str:
    """The command that fills some cells."""
    several = " -m" if len(environments) > 1 else ""
    usual = trajectories == 1 or method in WITHOUT_EXPERT
    more = "" if usual else f" ablation.trajectories={trajectories}"
    titles = ", ".join(ENVIRONMENTS[env] for env in environments)
    command = f"ril-run{several} env={','.join(environments)} method={method_named(method)}{more}"
    return f"- {method} is not run on {titles}: `{command}`"


def fullest_cell(rows: pd.DataFrame) -> pd.DataFrame:
    """Of several runs of one cell, the seeds of those that trained equally long, taken together.

    Of different lengths, that with the most seeds, then the longest; of a seed that was run
    twice, its newer row. The empty frame if there are none.
    """
    budgets = rows.groupby("run_id")[["total_timesteps", "epochs"]].transform("max").fillna(0)
    length = pd.Series(list(budgets.itertuples(index=False, name=None)), rows.index)
    seeds = rows.groupby(length)["seed"].nunique().sort_index()
    if seeds.empty:
        return rows
    chosen = seeds[seeds == seeds.max()].index[-1]
    together: pd.DataFrame = rows[length == chosen].drop_duplicates("seed", keep="last")
    return together.sort_values("seed")


def _spread(values: pd.Series[float], digits: int) -> str:
    return f"{values.mean():.{digits}f} ± {values.std(ddof=0):.{digits}f}"
