"""Measure ril's speed beside other libraries, and write the tables of docs/performance.md.

    python scripts/benchmark.py            # a quarter of an hour on an idle machine
    python scripts/benchmark.py --quick    # two minutes; everything except the projection

All measurements are single-threaded and in processor time. Figures are medians over rounds in which
the alternatives take turns. A seed-step is an environment step of one seed: ten seeds trained
together make ten at a time, Stable-Baselines3 makes one.
"""

from __future__ import annotations

import ril  # noqa: F401 - first, because it fixes the kernels of NumPy and torch

# isort: split

import argparse
import platform
import re
import time
from importlib.metadata import version
from pathlib import Path

import torch
from bench.growth import growth, start_up
from bench.loops import SETTINGS, dqn, ril_together
from bench.policies import ppo_and_gail
from bench.projection import projection
from bench.runs import prioritized, whole_runs
from bench.updates import measured as updates
from rich.console import Console

PAGE = Path(__file__).resolve().parents[1] / "docs" / "performance.md"
_MEASURED = re.compile(r"(<!-- measured -->\n).*(<!-- end of measured -->)", re.DOTALL)


def machine() -> str:
    """Describe the processor and the versions."""
    cpuinfo = Path("/proc/cpuinfo")
    found = re.search(r"model name\s*: (.*)", cpuinfo.read_text()) if cpuinfo.exists() else None
    name = found[1] if found else platform.processor() or platform.machine()
    return f"{name}, one thread, Python {platform.python_version()}, torch {version('torch')}"


def main() -> None:
    """Measure, print, and write the tables between the two markers of docs/performance.md."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--quick", action="store_true", help="fewer rounds, no projection")
    parser.add_argument("--rounds", type=int, help="of measurements (default: 3; 1 with --quick)")
    parser.add_argument("--sbx", type=Path, metavar="PYTHON", help="interpreter that has sbx-rl")
    parser.add_argument("--output", type=Path, default=PAGE, help="page to write to")
    arguments = parser.parse_args()
    quick, rounds = arguments.quick, arguments.rounds or (1 if arguments.quick else 3)
    torch.set_num_threads(1)
    started = time.monotonic()
    console = Console(highlight=False)
    parts = []

    def show(title: str, measured: str, *targets: str) -> None:
        parts.append(f"### {title}\n\n{measured}\n\n" + "".join(f"{line}\n\n" for line in targets))
        console.print(parts[-1], markup=False, soft_wrap=True)

    of_updates, ratio = updates(max(rounds, 3))
    show("An update", of_updates, f"Ten compiled against one module each: {ratio:.1f}× (aim: 20×).")
    of_dqn = dqn(rounds, 1000 if quick else 3000, 2 if quick else len(SETTINGS), arguments.sbx)
    show("Whole loops", of_dqn, "Aims, compiled: 20× at an update per step, 12× at one per four.")
    of_priority = prioritized(rounds, 1000 if quick else 3000)
    show("Prioritized replay", of_priority, "Aim: 0.6×.")
    of_ppo = ppo_and_gail(rounds, 2000 if quick else 20_000)
    show("PPO and GAIL", of_ppo, "Aims: 8× with ten seeds (LunarLander 4×), 1.5× with one.")
    of_ril, together = ril_together(rounds, 3 if quick else 10)
    show("Seeds together", of_ril, f"{together:.1f}× (aim: 6×).")
    show("Whole runs", whole_runs(1, 2 if quick else 10))
    of_start, helped = start_up(rounds)
    show("Start-up", of_start, f"`--help`: {helped:.2f} s (aim: below 1.5 s).")
    of_growth, memory = growth(quick)
    show("As work grows", of_growth, f"RIL with ten seeds: {memory:,.0f} MB (aim: below 1 GB).")
    if not quick:
        of_paper, hours = projection()
        show(
            "The whole paper",
            of_paper,
            f"All cells of Tables 2 to 9 with ten seeds: {hours:.0f} hours of one core, projected "
            "from the first epochs. Later episodes of CartPole and LunarLander are longer.",
        )
    conditions = f"{machine()}; {(time.monotonic() - started) / 60:.0f} minutes.\n\n"
    page = arguments.output
    text = page.read_text(encoding="utf-8") if page.exists() else ""
    if not _MEASURED.search(text):
        text += "<!-- measured -->\n<!-- end of measured -->\n"
    measured = conditions + "".join(parts)
    text = _MEASURED.sub(lambda match: f"{match[1]}{measured}{match[2]}", text)
    page.write_text(text, encoding="utf-8")
    console.print(f"{conditions.strip()} Written to {page}")


if __name__ == "__main__":
    main()
