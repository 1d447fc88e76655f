"""The layouts of npz demonstrations, each converted to the same arrays."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ril.environments.environment import Floats

Arrays = Mapping[str, NDArray[Any]]

#: ril's own layout; `ril-expert` adds `terminated`, which is not needed here.
OWN = ("observations", "actions", "rewards", "lengths")
#: The layout of IL-Datasets and Stable-Baselines 2; `episode_returns` is optional.
IL_DATASETS = ("obs", "actions", "rewards", "episode_starts")

_OPTIONAL = ("episode_returns",)
_WHOLE = ("actions", "lengths", "episode_starts")
_TABLES = ("observations", "obs")
#: Tolerance of `episode_returns`, as a share of the sum of |rewards|: the rounding error of adding
#: a thousand of them in float32.
_ROUNDING = 1e-4


class DataError(Exception):
    """A fault of demonstrations, in one line; `load_demonstrations` adds their path."""


class Trajectories(NamedTuple):
    """The arrays that every layout is converted to; see `Demonstrations` for their meaning."""

    observations: Floats
    actions: NDArray[np.int64]
    lengths: NDArray[np.int64]
    returns: NDArray[np.float64]


def read_npz(path: Path) -> Trajectories:
    """Read an npz file in either layout; nothing in it is ever unpickled.

    Raises:
        DataError: the file is damaged, not npz, in neither layout, or its arrays do not fit each
            other.
    """
    try:
        with path.open("rb") as file, np.load(file, allow_pickle=False) as archive:
            layout = _layout(archive.files)
            names = [name for name in (*layout, *_OPTIONAL) if name in archive.files]
            arrays = {name: _plain(archive, name) for name in names}
    except DataError:
        raise
    except Exception:  # zipfile, zlib and numpy raise many types on a damaged file
        raise DataError("not a readable npz file of plain arrays") from None
    return from_own(arrays) if layout == OWN else from_il_datasets(arrays)


def from_own(arrays: Arrays) -> Trajectories:
    """Convert ril's own layout of E trajectories with M transitions.

    Args:
        arrays: `observations` (M + E, obs), with each trajectory's final state; `actions` (M,);
            `rewards` (M,); `lengths` (E,).

    Raises:
        DataError: an array holds values of a wrong kind, or the arrays do not fit each other.
    """
    arrays = {name: _numbers(name, arrays[name]) for name in OWN}
    observations, actions, rewards, lengths = (arrays[name] for name in OWN)
    _check_lengths(lengths)
    steps = int(lengths.sum())
    for name, needed in (
        ("actions", steps),
        ("rewards", steps),
        ("observations", steps + len(lengths)),
    ):
        if len(arrays[name]) != needed:
            raise DataError(f"{name} has {len(arrays[name])} entries, its lengths require {needed}")
    returns = np.add.reduceat(rewards, np.cumsum(lengths) - lengths)
    return Trajectories(observations, actions, lengths, returns)


def from_il_datasets(arrays: Arrays) -> Trajectories:
    """Convert the layout of IL-Datasets: a row per step, N steps of E episodes.

    Episodes usually lack the state in which they end. T rows are then T − 1 pairs of states, and
    the last action is dropped, since it leads to no recorded state; IL-Datasets' own loader does
    the same. The last reward still counts in the return.

    Args:
        arrays: `obs` (N, obs), or (N + E, obs) with final states; `actions` (N,); `rewards` (N,);
            `episode_starts` (N,) of 0 and 1; optionally `episode_returns` (E,).

    Raises:
        DataError: an array holds values of a wrong kind, or the arrays do not fit each other.
    """
    arrays = {name: _numbers(name, array) for name, array in arrays.items()}
    observations, actions, rewards, is_start = (arrays[name] for name in IL_DATASETS)
    steps = len(is_start)
    if not np.isin(is_start, (0, 1)).all() or not is_start[:1].all():
        raise DataError("episode_starts must hold 0 and 1 only, and begin with 1")
    starts = np.flatnonzero(is_start)
    for name in ("actions", "rewards"):
        if len(arrays[name]) != steps:
            raise DataError(f"{name} has {len(arrays[name])} rows, episode_starts {steps}")
    with_final_states = steps + len(starts)
    if len(observations) not in (steps, with_final_states):
        raise DataError(
            f"obs has {len(observations)} rows; needs {steps}, as many as episode_starts, "
            f"or {with_final_states} with each episode's final state"
        )
    lengths = np.diff(starts, append=steps)
    if len(observations) == steps:
        actions = np.delete(actions, starts + lengths - 1)
        lengths -= 1
    _check_lengths(lengths)
    returns = np.add.reduceat(rewards, starts)
    if "episode_returns" in arrays:
        rounding = _ROUNDING * (1 + np.add.reduceat(np.abs(rewards), starts))
        returns = _checked_returns(arrays["episode_returns"], returns, rounding)
    return Trajectories(observations, actions, lengths, returns)


def _layout(names: Sequence[str]) -> tuple[str, ...]:
    """Return the first layout of which a file has all arrays."""
    for layout in (OWN, IL_DATASETS):
        if set(layout) <= set(names):
            return layout
    raise DataError(
        f"has the arrays {', '.join(sorted(names)) or '(none)'}; "
        f"needs {', '.join(OWN)} (ril's layout) or {', '.join(IL_DATASETS)} (IL-Datasets')"
    )


def _plain(archive: Mapping[str, NDArray[Any]], name: str) -> NDArray[Any]:
    """Return one array of an open npz file; refuse Python objects."""
    try:
        return np.asarray(archive[name])
    except ValueError as error:
        if "allow_pickle" not in str(error):
            raise
        raise DataError(f"{name} holds Python objects, which are never unpickled") from None


def _numbers(name: str, array: NDArray[Any]) -> NDArray[Any]:
    """Convert an array to the type of its name: int64, float32 or float64; (N, 1) becomes (N,)."""
    if array.dtype.kind not in "fiub":
        raise DataError(f"{name} holds {array.dtype}, needs numbers")
    dimensions = 2 if name in _TABLES else 1
    if dimensions == 1 and array.shape[1:] in ((), (1,)):
        array = array.reshape(-1)
    if array.ndim != dimensions:
        raise DataError(f"{name} has {array.ndim} dimension(s), needs {dimensions}")
    with np.errstate(over="ignore"):
        single = array.astype(np.float32)
    if not np.isfinite(single).all():
        raise DataError(f"{name} holds NaN or infinity")
    if name not in _WHOLE:
        return single if dimensions == 2 else array.astype(np.float64)
    if (array != np.rint(array)).any() or (np.abs(single) >= 2**31).any():
        raise DataError(f"{name} must hold whole numbers")
    return array.astype(np.int64)


def _check_lengths(lengths: NDArray[np.int64]) -> None:
    """Refuse a file without trajectories, or with one that has no pair of states."""
    if not len(lengths):
        raise DataError("holds no trajectory")
    if (short := np.flatnonzero(lengths < 1)).size:
        raise DataError(
            f"trajectory {short[0] + 1} of {len(lengths)} has {lengths[short[0]]} pairs of "
            "successive states, needs 1 or more"
        )


def _checked_returns(
    given: NDArray[np.float64], sums: NDArray[np.float64], rounding: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Return the (E,) returns of a file if they equal the sums of its rewards, up to rounding."""
    if len(given) != len(sums):
        raise DataError(
            f"episode_returns has {len(given)} entries, episode_starts {len(sums)} starts"
        )
    if (different := np.flatnonzero(np.abs(given - sums) > rounding)).size:
        raise DataError(
            f"episode_returns of trajectory {different[0] + 1} is {given[different[0]]:g}, "
            f"its rewards sum to {sums[different[0]]:g}"
        )
    return given
