"""Check that a run that is killed repeatedly leaves bit-identical rows and curves.

    python scripts/check_kills.py                  # bc, iupe, ril and dqn, 20 kills each
    python scripts/check_kills.py gail --kills 5   # another method

Each cell runs once without interruption. Then it is started again and again, and each start is
killed (SIGKILL) at a random moment within the time of the first run. When a start finishes before
its moment, its rows and curve are compared with the first run's, and the cell starts from scratch.
After the given number of kills the last start runs to its end. The script prints the table in
docs/resuming.md; its exit status is 1 if anything differs.

scripts/check_crashes.py ends small runs at each file operation, by functions that it puts in their
place. This script changes nothing in the process: `ril-run` with its own start, its checkpoints
every 5 seconds and longer runs.
"""

from __future__ import annotations

import argparse
import os
import random
import shutil
import subprocess
import sys
import tempfile
import time
from collections import Counter
from pathlib import Path

import pandas as pd

RIL_RUN = Path(sys.executable).with_name("ril-run")
SEEDS = "seeds=[100,101,102]"
MOUNTAINCAR, CARTPOLE = "env=mountaincar", "env=cartpole"
CELLS = {
    "bc": (MOUNTAINCAR, "method.epochs=60"),
    "iupe": (MOUNTAINCAR, "method.epochs=12"),
    "ril": (MOUNTAINCAR, "method.epochs=15"),
    "dqn": (CARTPOLE, "method.total_timesteps=10_000"),
    "dqn_prioritized": (CARTPOLE, "method.total_timesteps=10_000"),
    "acktr": (CARTPOLE, "method.total_timesteps=50_000"),
    "ilpo": (CARTPOLE,),
    "ppo": (CARTPOLE, "method.total_timesteps=20_000"),
    "gail": (CARTPOLE, "method.total_timesteps=20_000"),
}
STAGES = ("starting", "before a checkpoint", "between checkpoints", "scoring and rows")


def start(method: str, folder: Path) -> subprocess.Popen[bytes]:
    """Start the cell; its output is appended to a log in the folder."""
    folder.mkdir(exist_ok=True)
    command = [RIL_RUN, f"method={method}", SEEDS, *CELLS[method], f"output_dir={folder}/outputs"]
    with (folder / "log").open("ab") as log:
        return subprocess.Popen(command, stdout=log, stderr=log, env=os.environ)


def stage(folder: Path) -> str:
    """Return the stage in which a start was killed."""
    last = (folder / "log").read_text().rpartition("\nenv=")[2]
    if "scoring" in last:
        return "scoring and rows"
    if list(folder.rglob("checkpoint.pt")):
        return "between checkpoints"
    return "before a checkpoint" if list(folder.rglob("config.yaml")) else "starting"


def results(folder: Path) -> tuple[str, str]:
    """Return the rows without their times, and the curve."""
    [path] = folder.rglob("results.csv")
    rows = pd.read_csv(path, dtype=str).drop(columns="wall_seconds")
    return rows.to_csv(), path.with_name("curve.csv").read_text()


def check(method: str, kills: int, work: Path) -> tuple[str, bool]:
    """Check one method; return its line of the table, and whether all results were identical."""
    whole, killed = work / "whole", work / "killed"
    began = time.monotonic()
    if start(method, whole).wait():
        sys.exit((whole / "log").read_text())
    seconds = time.monotonic() - began
    expected, moments = results(whole), random.Random(0)
    stages: Counter[str] = Counter()
    same: list[bool] = []
    while True:
        last = stages.total() == kills
        process = start(method, killed)
        try:
            status = process.wait(None if last else moments.uniform(0, seconds))
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait()
            stages[stage(killed)] += 1
            print(f"{method}: kill {stages.total()} of {kills}", file=sys.stderr)
            continue
        if status:
            sys.exit((killed / "log").read_text())
        same.append(results(killed) == expected)
        if last:
            break
        shutil.rmtree(killed)
    counts = " | ".join(str(stages[name]) for name in STAGES)
    keys = " ".join(CELLS[method])
    line = f"| `method={method} {keys}` | {seconds:.0f} s | {counts} | {sum(same)} of {len(same)} |"
    return line, all(same)


def main() -> None:
    """Check the methods on the command line."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("methods", nargs="*", help=f"any of {', '.join(CELLS)}")
    parser.add_argument("--kills", type=int, default=20, help="per method (default: 20)")
    arguments = parser.parse_args()
    methods = arguments.methods or ["bc", "iupe", "ril", "dqn"]
    if unknown := [method for method in methods if method not in CELLS]:
        parser.error(f"{unknown[0]}: must be one of {', '.join(CELLS)}")
    lines, identical = [], []
    for method in methods:
        with tempfile.TemporaryDirectory() as work:
            line, same = check(method, arguments.kills, Path(work))
        print(line, flush=True)
        lines.append(line)
        identical.append(same)
    print(f"\n| | uninterrupted | {' | '.join(STAGES)} | bit-identical |\n" + "|---" * 7 + "|")
    print("\n".join(lines))
    sys.exit(not all(identical))


if __name__ == "__main__":
    main()
