"""Demonstrations on disk: which ship with the package, and any file read and checked."""

from __future__ import annotations

import hashlib
from pathlib import Path

import gymnasium as gym
import numpy as np

from ril.config.schema import Config
from ril.demonstrations.layouts import DataError, Trajectories, read_npz
from ril.demonstrations.minari import data_folder, read_minari
from ril.demonstrations.trajectories import Demonstrations
from ril.environments import Environment
from ril.io.errors import UserError

SHIPPED = Path(__file__).parent / "data"
_TOLERANCE = 0.01  # of the range of an observation's entry, which it may lie beyond its bounds
_OFF_LEVEL = 0.05  # of a sub-optimal expert's level, which its mean return may be off
_MAY_LEAVE = 0.1  # of all states; environments such as LunarLander leave their own space at times


def shipped_path(name: str) -> Path:
    """Where the demonstrations that come with the package lie for `env=name`."""
    return SHIPPED / f"{name}.npz"


def demonstrations_path(config: Config) -> Path:
    """What a run learns from: the path it gives, or the file that ships for its environment.

    Raises:
        UserError: none ships for it.
    """
    if config.demonstrations is not None:
        return Path(config.demonstrations)
    level = config.ablation.expert_return
    name = config.env.name if level is None else f"{config.env.name}_{level:g}"
    path = shipped_path(name)
    if not path.is_file():
        key = "demonstrations=null" if level is None else f"ablation.expert_return={level:g}"
        every = sorted(file.stem for file in path.parent.glob(f"{config.env.name}*.npz"))
        only = f" (only {', '.join(every)})" if every else ""
        raise UserError(f"{key}: none ship for {name}{only}; give demonstrations=PATH")
    return path


def check_level(config: Config, demonstrations: Demonstrations) -> None:
    """Refuse an expert that is not of the level that it is said to be.

    Raises:
        UserError: the mean return lies more than 5 % off `ablation.expert_return`.
    """
    level, mean = config.ablation.expert_return, demonstrations.returns.mean()
    if level is not None and abs(mean - level) > _OFF_LEVEL * abs(level):
        raise UserError(
            f"ablation.expert_return={level:g}: demonstrations={config.demonstrations} return "
            f"{mean:.2f} on average, more than 5 % off"
        )


def load_demonstrations(path: Path, environment: Environment) -> Demonstrations:
    """Read and check an npz file or a Minari dataset (docs/demonstrations.md).

    Nothing in it is ever unpickled.

    Raises:
        UserError: it is missing, unreadable or in no known layout, or holds shapes or values
            that do not fit each other or the environment.
    """
    try:
        if path.is_dir():
            folder = data_folder(path)
            found, digest = read_minari(folder, environment), _digest_of_folder(folder)
        elif path.is_file():
            found, digest = read_npz(path), _digest(path)
        else:
            raise DataError("no such file or folder")
        _check_fit(found, environment)
    except DataError as fault:
        raise UserError(f"demonstrations={path}: {fault}") from None
    return Demonstrations(*found, digest)


def _check_fit(found: Trajectories, environment: Environment) -> None:
    """Observations and actions are such as the environment has."""
    name = environment.config.id
    size, wanted = found.observations.shape[1], environment.observation_size
    if size != wanted:
        raise DataError(f"observations have {size} entries each, {name} has {wanted}")
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
    slack = _TOLERANCE * np.where(np.isfinite(high - low), high - low, 1)
    outside = (found.observations < low - slack) | (found.observations > high + slack)
    if outside.any(axis=1).mean() > _MAY_LEAVE:
        entry = int(outside.sum(axis=0).argmax())
        values = found.observations[:, entry]
        raise DataError(
            f"observations[:, {entry}] lie in {values.min():g}..{values.max():g}, {name} has "
            f"{low[entry]:g}..{high[entry]:g}; they must be raw, not scaled"
        )


def _digest(file: Path) -> str:
    """The SHA-256 of a file's content."""
    with file.open("rb") as opened:
        return hashlib.file_digest(opened, "sha256").hexdigest()


def _digest_of_folder(folder: Path) -> str:
    """The SHA-256 of the names and contents of all files in a folder, in the names' order."""
    files = sorted((f.relative_to(folder).as_posix(), f) for f in folder.rglob("*") if f.is_file())
    listing = "".join(f"{_digest(file)}  {name}\n" for name, file in files)
    return hashlib.sha256(listing.encode()).hexdigest()
