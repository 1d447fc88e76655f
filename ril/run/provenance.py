"""Record where a run's numbers come from: code, versions, machine, command."""

from __future__ import annotations

import hashlib
import os
import platform
import shlex
import subprocess
import sys
from datetime import UTC, datetime
from importlib.metadata import version
from pathlib import Path
from typing import Any

from ril import __version__, kernels
from ril.config.schema import Config
from ril.vectorized.compiling import compiler_version

_LIBRARIES = ("torch", "numpy", "gymnasium", "stable-baselines3", "hydra-core", "pandas")
_PACKAGE = Path(__file__).parents[1]
#: Folders of `ril/` whose code cannot change a number of a run.
_SHOWS_ONLY = ("report", "cli")


def commit() -> str:
    """Return the checkout's commit, with "-dirty" if it has changes; "" outside a checkout."""
    root = _PACKAGE.parent
    if not (root / ".git").exists():
        return ""
    try:
        head = _git(root, "rev-parse", "--short=12", "HEAD")
        return head + ("-dirty" if _git(root, "status", "--porcelain", "--", "ril", "conf") else "")
    except (OSError, subprocess.CalledProcessError):
        return ""


def command() -> str:
    """Return the command line, quoted so that a shell can run it again."""
    return shlex.join([Path(sys.argv[0]).name, *sys.argv[1:]])


def digits(config: Config) -> str:
    """Return "exact" if any machine computes the same digits as this process, or else why not."""
    if not config.exact:
        return "exact=false"
    if config.device != "cpu":
        return f"device={config.device}"
    return kernels.difference() or "exact"


def origin(identifier: str, config: Config) -> dict[str, str]:
    """Return what must be the same when a run resumes, so that all its rows are of one kind.

    Args:
        identifier: the run's `run_id`.
        config: its configuration.
    """
    return {
        "run_id": identifier,
        "ril": __version__,
        "code": _code(),
        "digits": digits(config),
        **{name: version(name) for name in _LIBRARIES[:4]},
    }


def _code() -> str:
    """Return a digest of the code that can change a number, uncommitted changes included."""
    digest = hashlib.sha256()
    for file in sorted(_PACKAGE.rglob("*.py")):
        name = file.relative_to(_PACKAGE)
        if name.parts[0] not in _SHOWS_ONLY:
            digest.update(f"{name.as_posix()}\0".encode() + file.read_bytes() + b"\0")
    return digest.hexdigest()[:12]


def provenance(demonstrations: Path, sha256: str, config: Config) -> dict[str, Any]:
    """Return the content of `provenance.json` at the start of a run.

    Args:
        demonstrations: path of the file.
        sha256: hash of its content.
        config: the run's configuration.
    """
    return {
        "command": command(),
        "started": datetime.now(UTC).isoformat(timespec="seconds"),
        "ril": __version__,
        "commit": commit(),
        "python": platform.python_version(),
        "versions": {name: version(name) for name in _LIBRARIES},
        "platform": f"{platform.system()} {platform.machine()}",
        "processor": _processor(),
        "libc": " ".join(platform.libc_ver()),
        "compiler": compiler_version(),
        "digits": digits(config),
        "cores": os.cpu_count(),
        "demonstrations": {"file": demonstrations.name, "sha256": sha256},
    }


def _git(root: Path, *arguments: str) -> str:
    command = ["git", "-C", str(root), *arguments]
    return subprocess.run(command, check=True, capture_output=True, text=True).stdout.strip()


def _processor() -> str:
    """Return the processor's name, as reported by Linux or else by Python."""
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
        return next(line.split(":", 1)[1].strip() for line in lines if "model name" in line)
    except (OSError, StopIteration):
        return platform.processor()
