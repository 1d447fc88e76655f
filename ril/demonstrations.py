"""Expert trajectories: read from npz, checked, cut to the first n, handed on without actions."""

from __future__ import annotations

import hashlib
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ril.environments import Environment, Floats
from ril.errors import UserError

SHIPPED = Path(__file__).parent / "data"
_ARRAYS = {"observations": 2, "actions": 1, "rewards": 1, "lengths": 1, "terminated": 1}


@dataclass(frozen=True)
class StateTransitions:
    """What a method that learns from observation may see of the expert: T^e (Alg. 1, line 3).

    Attributes:
        observations: (M, obs) scaled states s_t, all trajectories one after another.
        next_observations: (M, obs) scaled states s_{t+1}.
        trajectories: the number of trajectories.
    """

    observations: Floats
    next_observations: Floats
    trajectories: int

    @property
    def mean_length(self) -> float:
        """Transitions per trajectory, which sets the replay memory's size (§3.4)."""
        return len(self.observations) / self.trajectories


@dataclass(frozen=True)
class Demonstrations:
    """Trajectories of one expert.

    Attributes:
        observations: (M + E, obs) raw states; a trajectory of length T has T + 1 of them.
        actions: (M,) the expert's actions.
        rewards: (M,) rewards.
        lengths: (E,) transitions of each trajectory; they sum to M.
        terminated: (E,) whether the environment ended it, rather than the step limit.
        sha256: of the file.
    """

    observations: Floats
    actions: NDArray[np.int64]
    rewards: Floats
    lengths: NDArray[np.int64]
    terminated: NDArray[np.bool_]
    sha256: str = ""

    @property
    def returns(self) -> NDArray[np.float64]:
        """(E,) undiscounted return of each trajectory."""
        starts = np.cumsum(self.lengths) - self.lengths
        return np.add.reduceat(self.rewards, starts, dtype=np.float64)

    def first(self, trajectories: int) -> Demonstrations:
        """The first trajectories only, as the paper picks them.

        Raises:
            UserError: fewer are available.
        """
        available = len(self.lengths)
        if not 1 <= trajectories <= available:
            raise UserError(f"ablation.trajectories={trajectories}: must be within 1..{available}")
        transitions = int(self.lengths[:trajectories].sum())
        return Demonstrations(
            self.observations[: transitions + trajectories],
            self.actions[:transitions],
            self.rewards[:transitions],
            self.lengths[:trajectories],
            self.terminated[:trajectories],
            self.sha256,
        )

    def states(self, environment: Environment) -> StateTransitions:
        """The state-only view (s_t, s_{t+1}), scaled; actions and rewards stay behind."""
        last = np.cumsum(self.lengths + 1) - 1
        is_last = np.zeros(len(self.observations), dtype=bool)
        is_last[last] = True
        scaled = environment.scale(self.observations)
        return StateTransitions(scaled[~is_last], scaled[np.roll(~is_last, 1)], len(self.lengths))

    def save(self, path: Path) -> None:
        """Write a compressed npz with the arrays named as the attributes are."""
        np.savez_compressed(
            path, allow_pickle=False, **{name: getattr(self, name) for name in _ARRAYS}
        )


def shipped_path(name: str) -> Path:
    """Where the demonstrations that come with the package lie for `env=name`."""
    return SHIPPED / f"{name}.npz"


def load_demonstrations(path: Path, environment: Environment) -> Demonstrations:
    """Read and check a file of demonstrations; nothing in it is ever unpickled.

    Raises:
        UserError: the file is missing, torn, not npz, lacks an array, or holds shapes,
            values or actions that do not fit each other or the environment.
    """

    def refuse(fault: str) -> UserError:
        return UserError(f"demonstrations={path}: {fault}")

    if not path.is_file():
        raise refuse("no such file")
    try:
        with path.open("rb") as file, np.load(file, allow_pickle=False) as archive:
            arrays = {name: np.asarray(archive[name]) for name in _ARRAYS if name in archive}
    except Exception:  # a damaged file has zipfile, zlib and numpy raise a dozen kinds
        raise refuse("not a readable npz file of plain arrays") from None
    if missing := _ARRAYS.keys() - arrays.keys():
        raise refuse(f"lacks the array(s) {', '.join(sorted(missing))}")

    for name, dimensions in _ARRAYS.items():
        if arrays[name].ndim != dimensions:
            raise refuse(f"{name} has {arrays[name].ndim} dimension(s), needs {dimensions}")
        if arrays[name].dtype.kind not in "fiub":
            raise refuse(f"{name} holds {arrays[name].dtype}, needs numbers")
        with np.errstate(over="ignore"):
            finite = np.isfinite(arrays[name].astype(np.float32)).all()
        if not finite:
            raise refuse(f"{name} holds NaN or infinity")
    for name in ("actions", "lengths"):
        if arrays[name].dtype.kind not in "iu":
            raise refuse(f"{name} holds {arrays[name].dtype}, needs integers")

    observations, actions, lengths = arrays["observations"], arrays["actions"], arrays["lengths"]
    if len(lengths) == 0 or (lengths < 1).any():
        raise refuse("lengths must name at least one trajectory, each of one step or more")
    if len(arrays["terminated"]) != len(lengths):
        raise refuse(f"terminated has {len(arrays['terminated'])} entries, lengths {len(lengths)}")
    for name, entries, needed in (
        ("actions", len(actions), int(lengths.sum())),
        ("rewards", len(arrays["rewards"]), int(lengths.sum())),
        ("observations", len(observations), int(lengths.sum()) + len(lengths)),
    ):
        if entries != needed:
            raise refuse(f"{name} has {entries} entries, its lengths say {needed}")
    if observations.shape[1] != environment.observation_size:
        raise refuse(
            f"observations have {observations.shape[1]} entries each, "
            f"{environment.config.id} has {environment.observation_size}"
        )
    if actions.min() < 0 or actions.max() >= environment.action_count:
        raise refuse(
            f"actions lie in {actions.min()}..{actions.max()}, "
            f"{environment.config.id} has 0..{environment.action_count - 1}"
        )
    return Demonstrations(
        observations.astype(np.float32),
        actions.astype(np.int64),
        arrays["rewards"].astype(np.float32),
        lengths.astype(np.int64),
        arrays["terminated"].astype(bool),
        hashlib.sha256(path.read_bytes()).hexdigest(),
    )
