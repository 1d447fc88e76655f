"""Check that two sweeps of the same cells at once, one of them killed, run every cell once.

    python scripts/check_sweeps.py              # 200 cells
    python scripts/check_sweeps.py --cells 40

Two processes start the same sweep (joblib, all cores) into one folder. After ten seconds one of
them is killed (SIGKILL). When the other has ended, every cell must have one folder and its rows
once, equal to those of a run of its own; the remaining process's memory is sampled meanwhile. The
exit status is 1 if anything is wrong.
"""

from __future__ import annotations

import argparse
import re
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import pandas as pd

RIL_RUN = Path(sys.executable).with_name("ril-run")
FIRST_SEED = 1000
CELL = (
    *("env=cartpole", "method=bc", "method.epochs=2", "method.cloning.updates=10"),
    *("evaluation.episodes=2", "evaluation.selection_episodes=2"),
)
_KILLED_AFTER = 10.0  # seconds


def sweep(seeds: range, folder: Path, log: Path) -> subprocess.Popen[bytes]:
    """Start a sweep with a cell per seed."""
    values = ",".join(f"[{seed}]" for seed in seeds)
    command = [RIL_RUN, "-m", *CELL, f"seeds={values}", f"output_dir={folder}"]
    with log.open("wb") as opened:
        return subprocess.Popen(command, stdout=opened, stderr=opened, start_new_session=True)


def megabytes(process: subprocess.Popen[bytes]) -> float:
    """Return the memory of a running process, without its workers'; 0 once it has ended."""
    try:
        status = Path(f"/proc/{process.pid}/status").read_text()
    except OSError:
        return 0.0
    found = re.search(r"VmRSS:\s*(\d+) kB", status)
    return int(found[1]) / 1024 if found else 0.0


def rows(folder: Path) -> pd.DataFrame:
    """Return all rows below a folder, without their times, by seed."""
    found = [pd.read_csv(path, dtype=str) for path in sorted(folder.rglob("results.csv"))]
    together = pd.concat(found, ignore_index=True).drop(columns="wall_seconds")
    return together.sort_values("seed", ignore_index=True)


def main() -> None:
    """Run the check and print what was seen."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--cells", type=int, default=200, help="number of cells (default: 200)")
    seeds = range(FIRST_SEED, FIRST_SEED + parser.parse_args().cells)
    with tempfile.TemporaryDirectory() as work:
        outputs, log = Path(work, "outputs"), Path(work, "log")
        began = time.monotonic()
        killed = sweep(seeds, outputs, Path(work, "killed"))
        kept = sweep(seeds, outputs, log)
        memory: list[float] = []
        was_killed = False
        while kept.poll() is None:
            time.sleep(1)
            memory.append(megabytes(kept))
            if time.monotonic() - began > _KILLED_AFTER and killed.poll() is None:
                print(f"killed one sweep with {len(rows_so_far(outputs))} of {len(seeds)} cells")
                killed.kill()
                killed.wait()
                was_killed = True
        seconds = time.monotonic() - began
        killed.kill()
        killed.wait()
        found = rows(outputs)
        folders = [path for path in outputs.glob("*/*/*") if path.is_dir()]
        alone = Path(work, "alone")
        sample = seeds[:: max(1, len(seeds) // 5)]
        for seed in sample:
            command = [RIL_RUN, *CELL, f"seeds=[{seed}]", f"output_dir={alone}"]
            subprocess.run(command, check=True, stdout=subprocess.DEVNULL)
        expected = rows(alone)
        repeated = found[found["seed"].isin(expected["seed"])].reset_index(drop=True)
        half = memory[len(memory) // 2 : -1] or memory
        facts = {
            "one sweep was killed": was_killed,
            "exit status of the other sweep is 0": kept.returncode == 0,
            f"{len(seeds)} folders": len(folders) == len(seeds),
            "a row per cell": found["seed"].tolist() == [str(seed) for seed in seeds],
            f"rows of {len(sample)} cells equal those of runs alone": repeated.equals(expected),
            "no checkpoint, lock or temporary file is left": not [
                *outputs.rglob("checkpoint.pt"),
                *outputs.rglob(".*.tmp"),
                *outputs.rglob(".lock"),
                *outputs.rglob(".holder"),
            ],
        }
        for fact, holds in facts.items():
            print(f"{'yes' if holds else 'NO'}: {fact}")
        print(
            f"{seconds:.0f} s; the parent's memory: {half[0]:.0f} MB halfway, {max(half):.0f} after"
        )
        if not all(facts.values()):
            print(log.read_text())
            sys.exit(1)


def rows_so_far(folder: Path) -> list[Path]:
    """Return the files of rows that exist."""
    return list(folder.rglob("results.csv"))


if __name__ == "__main__":
    main()
