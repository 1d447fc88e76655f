"""Find and load demonstrations: the shipped files, or a file of the user's, fully checked."""

from __future__ import annotations

import dataclasses
import hashlib
import json
from pathlib import Path

import gymnasium as gym
import numpy as np

from ril.config.schema import Config
from ril.demonstrations.layouts import DataError, Trajectories, read_npz
from ril.demonstrations.minari import data_folder, read_minari
from ril.demonstrations.trajectories import Demonstrations
from ril.environments.environment import Environment
from ril.io.errors import UserError

SHIPPED = Path(__file__).parent / "data"
_BOUND_TOLERANCE = 0.01  # margin beyond an observation's bounds, as a share of their range
_LEVEL_TOLERANCE = 0.05  # of `ablation.expert_return`, by which the mean return may differ
#: Share of states that may lie outside the bounds: LunarLander's leave its own space at times.
_MAX_SHARE_OUTSIDE = 0.1


def shipped_path(name: str) -> Path:
    """Return the path of a shipped file, such as `mountaincar` or `mountaincar_-140`."""
    return SHIPPED / f"{name}.npz"


def demonstrations_path(config: Config) -> Path:
    """Return the path of a run's demonstrations: the user's, or the file shipped for its cell.

    Raises:
        UserError: no file is shipped for this environment and expert level.
    """
    if config.demonstrations is not None:
        return Path(config.demonstrations)
    level = config.ablation.expert_return
    name = _cell_name(config)
    files = {file.stem: file for file in SHIPPED.glob("*.npz")}
    if name not in files:
        key = "demonstrations=null" if level is None else f"ablation.expert_return={level:g}"
        available = sorted(each for each in files if each.partition("_")[0] == config.env.name)
        only = f", only for {', '.join(available)}" if available else ""
        raise UserError(f"{key}: no file is shipped for {name}{only}; give demonstrations=PATH")
    if (made_in := _made_in(files[name])) != config.env.id:
        raise UserError(
            f"env.id={config.env.id}: the file that is shipped for {name} is of {made_in}; "
            "give demonstrations=PATH"
        )
    return files[name]


def are_shipped(config: Config) -> bool:
    """Return whether a run's demonstrations are those shipped for its cell, wherever they are.

    Raises:
        UserError: the demonstrations cannot be read.
    """
    if config.demonstrations is None:
        return True
    try:
        shipped = demonstrations_path(dataclasses.replace(config, demonstrations=None))
    except UserError:
        return False
    return content_hash(Path(config.demonstrations)) == content_hash(shipped)


def content_hash(path: Path) -> str:
    """Return the SHA-256 of the content of an npz file or a Minari dataset.

    Raises:
        UserError: the path is missing or cannot be read.
    """
    try:
        if path.is_dir():
            return _folder_digest(data_folder(path))
        if path.is_file():
            return _digest(path)
        raise DataError("no such file or folder")
    except DataError as fault:
        raise UserError(f"demonstrations={path}: {fault}") from None
    except OSError as error:
        raise UserError(f"demonstrations={path}: cannot be read ({error.strerror})") from None


def _cell_name(config: Config) -> str:
    """Return the name of the file that would be shipped for a cell."""
    level = config.ablation.expert_return
    return config.env.name if level is None else f"{config.env.name}_{level:g}"


def _made_in(path: Path) -> str:
    """Return the id of the environment in which a shipped file was made, by its record."""
    record = json.loads(path.with_suffix(".json").read_text(encoding="utf-8"))
    made_in: str = record["config"]["env"]["id"]
    return made_in


def check_level(config: Config, demonstrations: Demonstrations) -> None:
    """Refuse demonstrations that do not match `ablation.expert_return` (§7).

    Raises:
        UserError: their mean return differs from it by more than 5 %.
    """
    level, mean = config.ablation.expert_return, demonstrations.returns.mean()
    if level is not None and abs(mean - level) > _LEVEL_TOLERANCE * abs(level):
        raise UserError(
            f"ablation.expert_return={level:g}: the mean return of "
            f"demonstrations={config.demonstrations} is {mean:.2f}; it may differ by at most 5 %"
        )


def load_demonstrations(path: Path, environment: Environment) -> Demonstrations:
    """Load and check an npz file or a Minari dataset (docs/demonstrations.md).

    Nothing in it is ever unpickled.

    Args:
        path: the npz file, or the dataset's folder.
        environment: whose observation and action spaces the arrays must fit.

    Raises:
        UserError: the path is missing or unreadable, its layout is unknown, or its arrays fit
            neither each other nor the environment.
    """
    try:
        if path.is_dir():
            folder = data_folder(path)
            found, digest = read_minari(folder, environment), _folder_digest(folder)
        elif path.is_file():
            found, digest = read_npz(path), _digest(path)
        else:
            raise DataError("no such file or folder")
        _check_fit(found, environment)
    except DataError as fault:
        raise UserError(f"demonstrations={path}: {fault}") from None
    return Demonstrations(*found, digest)


def _check_fit(found: Trajectories, environment: Environment) -> None:
    """Refuse observations or actions that lie outside the environment's spaces."""
    name = environment.config.id
    size, expected = found.observations.shape[1], environment.observation_size
    if size != expected:
        raise DataError(f"observations have {size} entries each, {name} has {expected}")
    first, last = found.actions.min(), found.actions.max()
    if first < 0 or last >= environment.action_count:
        raise DataError(
            f"actions lie in {first}..{last}, {name} has 0..{environment.action_count - 1}"
        )
    probe = environment.make()
    space = probe.observation_space
    probe.close()
    assert isinstance(space, gym.spaces.Box)  # load_environment has checked it
    low, high = space.low.astype(np.float64), space.high.astype(np.float64)
    margin = _BOUND_TOLERANCE * np.where(np.isfinite(high - low), high - low, 1)
    outside = (found.observations < low - margin) | (found.observations > high + margin)
    if outside.any(axis=1).mean() > _MAX_SHARE_OUTSIDE:
        entry = int(outside.sum(axis=0).argmax())
        values = found.observations[:, entry]
        raise DataError(
            f"observations[:, {entry}] lie in {values.min():g}..{values.max():g}, {name} has "
            f"{low[entry]:g}..{high[entry]:g}; they must be raw, not scaled"
        )


def _digest(file: Path) -> str:
    """Return the SHA-256 of a file's content."""
    with file.open("rb") as opened:
        return hashlib.file_digest(opened, "sha256").hexdigest()


def _folder_digest(folder: Path) -> str:
    """Return the SHA-256 of the sorted names and contents of all files in a folder."""
    files = sorted((f.relative_to(folder).as_posix(), f) for f in folder.rglob("*") if f.is_file())
    listing = "".join(f"{_digest(file)}  {name}\n" for name, file in files)
    return hashlib.sha256(listing.encode()).hexdigest()
