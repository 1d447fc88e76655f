"""Demonstrations as Minari stores them: a folder with one HDF5 file of episodes."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
from gymnasium.spaces import Box, Discrete, Space

from ril.demonstrations.layouts import DataError, Trajectories, from_own
from ril.environments import Environment
from ril.io.errors import one_line


def data_folder(path: Path) -> Path:
    """Where a dataset's files lie, whether its own folder is given or the `data` in it.

    Raises:
        DataError: there is no Minari dataset.
    """
    for folder in (path, path / "data"):
        if (folder / "metadata.json").is_file():
            return folder
    raise DataError("a folder, but not of a Minari dataset: has no data/metadata.json")


def read_minari(folder: Path, environment: Environment) -> Trajectories:
    """Read a dataset's data folder, episode by episode.

    Raises:
        DataError: minari is not installed or cannot read it, its spaces are not the environment's,
            or its arrays do not fit each other.
    """
    try:
        # Of a dataset without spaces, minari would make the environment that its metadata name,
        # and that may be any function of any module.
        metadata = json.loads((folder / "metadata.json").read_text(encoding="utf-8"))
        if not {"observation_space", "action_space"} <= metadata.keys():
            raise DataError("metadata.json lacks observation_space or action_space")
        from minari import MinariDataset

        dataset = MinariDataset(folder)
        _check_spaces(dataset.observation_space, dataset.action_space, environment)
        episodes = list(dataset)
        _check_final_states([(len(each.observations), len(each.actions)) for each in episodes])
        arrays = {
            name: np.concatenate([getattr(each, name) for each in episodes])
            for name in ("observations", "actions", "rewards")
        }
    except DataError:
        raise
    except ImportError as error:
        raise DataError(
            f"reading Minari needs pip install -e '.[minari]' ({one_line(error)})"
        ) from None
    except Exception as error:  # a damaged file has json, gymnasium, h5py and minari raise theirs
        raise DataError(
            f"minari cannot read it ({type(error).__name__}: {one_line(error)})"
        ) from None
    return from_own(arrays | {"lengths": np.array([len(each.actions) for each in episodes])})


def _check_spaces(observations: Space[Any], actions: Space[Any], environment: Environment) -> None:
    """Observations are vectors of the environment's size, and actions its own, counted from 0."""
    name, shape, count = (
        environment.config.id,
        (environment.observation_size,),
        environment.action_count,
    )
    if not isinstance(observations, Box) or observations.shape != shape:
        raise DataError(
            f"observations are {one_line(observations)}, {name} has a Box of shape {shape}"
        )
    if not isinstance(actions, Discrete) or (actions.start, actions.n) != (0, count):
        raise DataError(f"actions are {one_line(actions)}, {name} has Discrete({count})")


def _check_final_states(counts: list[tuple[int, int]]) -> None:
    """Every episode has one observation more than actions."""
    if not counts:
        raise DataError("holds no trajectory")
    for number, (observations, actions) in enumerate(counts, start=1):
        if observations != actions + 1:
            raise DataError(
                f"trajectory {number} of {len(counts)} has {observations} observations "
                f"for {actions} actions, needs one more than these"
            )
