"""Identify a run by a hash of everything that can change its numbers, and of nothing else."""

from __future__ import annotations

import dataclasses
import hashlib
import json
from pathlib import Path

from ril.config.schema import Config
from ril.methods.registry import spec

#: Keys that cannot change a number; demonstrations are hashed by content, not by path.
_NOT_IN_RUN_ID = ("output_dir", "resume", "demonstrations", "logging")


def run_id(config: Config, demonstrations_sha256: str) -> str:
    """Return ten hexadecimal digits that identify a run.

    Args:
        config: the run's configuration.
        demonstrations_sha256: hash of the demonstrations' content.
    """
    content = dataclasses.asdict(config)
    for key in _NOT_IN_RUN_ID:
        del content[key]
    del content["env"]["vectorized"]  # results are bit-identical either way
    content["demonstrations"] = demonstrations_sha256
    if not config.exact:
        del content["exact"]
    method = spec(config.method.name)
    # auto may decide differently on another machine, where the last bits may differ anyway.
    if config.compile == "auto" or not method.compiles:
        del content["compile"]
    for key in method.idle_ablations:
        del content["ablation"][key]
    canonical = json.dumps(content, sort_keys=True)
    return hashlib.sha256(canonical.encode()).hexdigest()[:10]


def run_folder(config: Config, demonstrations_sha256: str) -> Path:
    """Return the folder of a run: `<output_dir>/<env>/<method>/<run_id>`."""
    identifier = run_id(config, demonstrations_sha256)
    return Path(config.output_dir) / config.env.name / config.method.name / identifier
