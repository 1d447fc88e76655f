"""Invented rows for tests of the report."""

from __future__ import annotations

from pathlib import Path

import pandas as pd

from ril.io.rows import Row
from ril.report.evidence import Evidence
from ril.report.findings import Finding, find
from ril.report.paper.tables import Cell, Setting, table

USUAL = {
    "run_id": "a",
    "env": "mountaincar",
    "method": "ril",
    "variant": "",
    "seed": 0,
    "k": 2.0,
    "n": 150.0,
    "trajectories": 1,
    "expert_return": None,
    "epochs": 150,
    "env_samples": 2_000_000,
    "expert_samples": 15_900,
    "pre_samples": 15_000,
    "aer": -105.0,
    "aer_last": -110.0,
    "performance": 1.0,
    "random_return": -200.0,
    "expert_return_measured": -100.0,
}
#: The columns of a method that learns from rewards alone.
ALONE = {"k": None, "n": None, "trajectories": None, "total_timesteps": 2_000_000}


def rows(*cells: dict[str, object]) -> pd.DataFrame:
    """Rows of Table 2's setting with some values changed."""
    columns = [*Row.__dataclass_fields__, "folder"]
    made = pd.DataFrame([USUAL | cell for cell in cells]).reindex(columns=columns)
    return made.assign(folder=[Path(run_id) for run_id in made["run_id"]])


def evidence(*cells: dict[str, object], curves: pd.DataFrame | None = None) -> Evidence:
    """Such rows, and their learning curves."""
    columns = ["run_id", "seed", "epoch", "samples", "aer"]
    return Evidence(rows(*cells), pd.DataFrame(columns=columns) if curves is None else curves)


def cell_of(name: str, quantity: str, **setting: object) -> Cell:
    """The cell of a table with these fields."""
    [cell] = [
        cell
        for cell in table(name).cells()
        if cell.quantity == quantity
        and all(getattr(cell.setting, key) == value for key, value in setting.items())
    ]
    return cell


def found(name: str, quantity: str, given: Evidence, **setting: object) -> Finding:
    """The rows' result for that cell."""
    return find(cell_of(name, quantity, **setting), given)


def setting(method: str = "RIL", env: str = "mountaincar", **more: float) -> Setting:
    """A setting of Table 2."""
    return Setting(**{"method": method, "env": env, "trajectories": 1, "k": 2, "n": 150, **more})
