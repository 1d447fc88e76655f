"""The paper's tables with our rows beside them, as Markdown."""

from __future__ import annotations

import pandas as pd

from ril.report.paper import ENVIRONMENTS, in_setting, number, paper

TUNING_SEEDS = 100  # settings are chosen on seeds from here up, which are not reported on


def table2(rows: pd.DataFrame) -> str:
    """Table 2's RIL row: ours, the paper's, and what is left to run.

    Args:
        rows: as `results.load_results` returns them.
    """
    reported = paper()["table2"]
    ril = rows[(rows["method"] == "ril") & (rows["seed"] < TUNING_SEEDS)]
    candidates = ril[in_setting(ril, "table2")]
    lines = [
        f"**{reported['caption']}**: average episodic reward and performance P of RIL,",
        "mean ± standard deviation over seeds.",
        "",
        "| RIL | " + " | ".join(ENVIRONMENTS.values()) + " | Average P |",
        "|---" * (len(ENVIRONMENTS) + 2) + "|",
    ]
    ours, performances, notes, performance = [], [], [], []
    for env, title in ENVIRONMENTS.items():
        cell = fullest_run(candidates[candidates["env"] == env])
        apart = ril.loc[(ril["env"] == env) & (ril["variant"] != ""), "run_id"].nunique()
        if apart:
            notes.append(f"- {title}: left out, since they set keys of their own: {apart} runs")
        if cell.empty:
            ours.append("not run")
            performances.append("–")
            notes.append(f"- {title} is not run: `ril-run env={env} method=ril`")
            continue
        seeds = "1 seed" if len(cell) == 1 else f"{len(cell)} seeds"
        ours.append(f"{_spread(cell['aer'], 2)} ({seeds})")
        performances.append(_spread(cell["performance"], 3))
        performance.append(cell["performance"].mean())
        short = [
            f"{have} of {reported[what]} {what}"
            for what, have in (("seeds", len(cell)), ("epochs", cell["epochs"].max()))
            if have < reported[what]
        ]
        if short:
            notes.append(f"- {title} was run with {' and '.join(short)}")
        others = candidates.loc[candidates["env"] == env, "run_id"].nunique() - 1
        if others:
            run = cell["run_id"].iloc[0]
            notes.append(f"- {title}: of {others + 1} runs, {run} is shown, the fullest")
    average = f"{sum(performance) / 4:.3f}" if len(performance) == 4 else "–"
    by_paper = [number(reported["returns"]["RIL"][env]) for env in ENVIRONMENTS]
    paper_average = number(reported["average_performance"]["RIL"])
    lines.append("| AER, ours | " + " | ".join(ours) + " | |")
    lines.append("| AER, paper | " + " | ".join(by_paper) + " | |")
    lines.append("| P, ours | " + " | ".join(performances) + f" | {average} |")
    lines.append("| P, paper | " + " | " * 4 + f"{paper_average} |")
    return "\n".join(lines + (["", *notes] if notes else []))


def fullest_run(rows: pd.DataFrame) -> pd.DataFrame:
    """Of several runs of one cell, that with the most seeds, then epochs; the empty if none."""
    if rows.empty:
        return rows
    sizes = rows.groupby("run_id").agg(seeds=("seed", "size"), epochs=("epochs", "max"))
    chosen = sizes.sort_values(["seeds", "epochs"], kind="stable").index[-1]
    of_chosen: pd.DataFrame = rows[rows["run_id"] == chosen]
    return of_chosen


def _spread(values: pd.Series[float], digits: int) -> str:
    return f"{values.mean():.{digits}f} ± {values.std(ddof=0):.{digits}f}"
