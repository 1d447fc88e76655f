"""Minari datasets of demonstrations: a folder with one HDF5 file of episodes."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
from gymnasium.spaces import Box, Discrete, Space

from ril.demonstrations.layouts import DataError, Trajectories, from_own
from ril.environments.environment import Environment
from ril.io.errors import one_line


def data_folder(path: Path) -> Path:
    """Return the `data` folder of a dataset, given that folder or its parent.

    Raises:
        DataError: neither holds a Minari dataset.
    """
    for folder in (path, path / "data"):
        if (folder / "metadata.json").is_file():
            return folder
    raise DataError("a folder without data/metadata.json, so not a Minari dataset")


def read_minari(folder: Path, environment: Environment) -> Trajectories:
    """Read all episodes of a dataset.

    Args:
        folder: the dataset's `data` folder.
        environment: whose spaces the dataset must have.

    Raises:
        DataError: minari is not installed or cannot read the dataset, its spaces are not the
            environment's, or its arrays do not fit each other.
    """
    try:
        # If the metadata name no spaces, minari creates the environment that they name, which can
        # be any function of any module.
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
    except Exception as error:  # json, gymnasium, h5py and minari raise many types
        raise DataError(
            f"minari cannot read it ({type(error).__name__}: {one_line(error)})"
        ) from None
    return from_own(arrays | {"lengths": np.array([len(each.actions) for each in episodes])})


def _check_spaces(observations: Space[Any], actions: Space[Any], environment: Environment) -> None:
    """Refuse spaces other than a vector of the environment's size and its actions from 0."""
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
    """Refuse episodes without a final state: (observations, actions) counts must differ by 1."""
    if not counts:
        raise DataError("holds no trajectory")
    for number, (observations, actions) in enumerate(counts, start=1):
        if observations != actions + 1:
            raise DataError(
                f"trajectory {number} of {len(counts)} has {observations} observations "
                f"for {actions} actions, needs {actions + 1}"
            )
