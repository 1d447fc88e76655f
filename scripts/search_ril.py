"""Which of RIL's open choices matter? Settings tried on tuning seeds and another trajectory.

    python scripts/search_ril.py FILE [ENV …]

FILE has a setting per line, as overrides of `ril-run`. Each is run on the environments with seeds
100 to 104, from a trajectory other than the first, which reported runs see; a row of each goes to
docs/search/<method>.csv. What has a row is not run again.
"""

from __future__ import annotations

import csv
import fcntl
import sys
import tempfile
import time
from pathlib import Path

import hydra
import numpy as np
import pandas as pd

from ril.cli import store_schemas
from ril.config import from_hydra
from ril.experiment import run
from ril.paths import config_folder

SEARCH = Path(__file__).resolve().parents[1] / "docs" / "search"
COLUMNS = (
    "setting", "env", "expert", "seeds", "performance", "aer", "aer_std", "aer_last", "aer_last_std",
    "worst", "samples_to_best", "samples", "seconds",
)


class Silent:
    def started(self, *a): ...
    def advanced(self, *a): ...
    def scoring(self): ...
    def noted(self, line): print(line)
    def finished(self, *a, **k): ...


def tuning_demonstrations(env: str, folder: Path) -> Path:
    """The expert's file with another trajectory first: of those left, the nearest in length."""
    import ril.data
    data = np.load(Path(ril.__file__).parent / "data" / f"{env}.npz")
    arrays = {k: data[k] for k in data.files}
    lengths = arrays["lengths"]
    ends = np.cumsum(lengths)
    steps = np.split(np.arange(ends[-1]), ends[:-1])
    # observations have T+1 rows
    oends = np.cumsum(lengths + 1)
    orows = np.split(np.arange(oends[-1]), oends[:-1])
    returns = np.array([arrays["rewards"][s].sum() for s in steps])
    others = np.arange(1, len(lengths))
    pick = others[np.argmin(np.abs(returns[others] - returns[0]), axis=0)]
    order = [pick, *[i for i in others if i != pick]]
    out = {
        "observations": np.concatenate([arrays["observations"][orows[i]] for i in order]),
        "actions": np.concatenate([arrays["actions"][steps[i]] for i in order]),
        "rewards": np.concatenate([arrays["rewards"][steps[i]] for i in order]),
        "lengths": lengths[order],
        "terminated": arrays["terminated"][order],
    }
    path = folder / f"{env}.npz"
    np.savez_compressed(path, **out)
    print(env, "first", returns[0], "tuning on", returns[pick], flush=True)
    return path


def main() -> None:
    store_schemas()
    out = Path(sys.argv[1])
    settings = [l.strip() for l in Path(sys.argv[2]).read_text().splitlines() if l.strip() and not l.startswith("#")]
    envs = sys.argv[3:]
    scratch = Path(tempfile.mkdtemp(prefix="search"))
    demos = {e: tuning_demonstrations(e, scratch) for e in envs}
    for setting in settings:
        for env in envs:
            out.touch()
            if out.stat().st_size and ((old := pd.read_csv(out)).setting.eq(setting) & old.env.eq(env)).any():
                continue
            words = setting.split()
            base = env.split("_")[0]
            with hydra.initialize_config_dir(str(config_folder()), version_base="1.3"):
                config = from_hydra(hydra.compose("config", [
                    f"env={base}", "seeds=[100,101,102,103,104]", f"output_dir={scratch}/o",
                    f"demonstrations={demos[env]}", "resume=false", *words]))
            t = time.process_time()
            folder = run(config, Silent())
            seconds = time.process_time() - t
            r = pd.read_csv(folder / "results.csv")
            c = pd.read_csv(folder / "curve.csv")
            row = dict(setting=setting, env=env, expert=0, seeds=5, performance=r.performance.mean(),
                aer=r.aer.mean(), aer_std=r.aer.std(ddof=0), aer_last=r.aer_last.mean(), aer_last_std=r.aer_last.std(ddof=0),
                worst=r.aer.min(), samples_to_best=r.samples_to_best.mean(), samples=(r.env_samples+r.expert_samples).mean(), seconds=seconds)
            with out.open("a") as f:
                fcntl.flock(f, fcntl.LOCK_EX)
                w = csv.DictWriter(f, COLUMNS)
                if f.tell() == 0: w.writeheader()
                w.writerow({k: round(v, 3) if isinstance(v, float) else v for k, v in row.items()})
            mid = c.groupby("epoch").aer.mean()
            print(f"{env:16s} {row['aer']:8.2f} ± {row['aer_std']:6.2f} last {row['aer_last']:8.2f} worst {row['worst']:8.2f} stb {row['samples_to_best']:.0f} {seconds:.0f}s  | {setting} | " + " ".join(f"{mid[e]:.0f}" for e in mid.index[4::5]), flush=True)


main()
