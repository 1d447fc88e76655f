"""Expert trajectories: the first n of them, as states only or with the expert's actions."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ril.environments.environment import Environment, Floats
from ril.io.errors import UserError


@dataclass(frozen=True)
class StateTransitions:
    """The expert's transitions T^e without actions (Alg. 1, line 3).

    Attributes:
        observations: (M, obs) scaled states s_t, trajectory after trajectory.
        next_observations: (M, obs) scaled states s_{t+1}.
        trajectories: the number of trajectories.
    """

    observations: Floats
    next_observations: Floats
    trajectories: int

    @classmethod
    def none(cls, environment: Environment) -> StateTransitions:
        """Return no transitions, for methods that see no expert."""
        nothing = np.zeros((0, environment.observation_size), dtype=np.float32)
        return cls(nothing, nothing, trajectories=0)

    @property
    def mean_length(self) -> float:
        """Return the mean number of transitions per trajectory; it sizes the replay (§3.4)."""
        return len(self.observations) / self.trajectories


@dataclass(frozen=True)
class LabeledTransitions(StateTransitions):
    """The expert's transitions with its actions, for methods that see the ground truth.

    Attributes:
        actions: (M,) the expert's actions in the states s_t.
    """

    actions: NDArray[np.int64]


@dataclass(frozen=True)
class Demonstrations:
    """Trajectories of one expert.

    Attributes:
        observations: (M + E, obs) raw states; a trajectory of T transitions has T + 1 states.
        actions: (M,) the expert's actions.
        lengths: (E,) transitions of each trajectory; they sum to M.
        returns: (E,) undiscounted return of each trajectory.
        sha256: of the file, or of the names and contents of a dataset's files.
    """

    observations: Floats
    actions: NDArray[np.int64]
    lengths: NDArray[np.int64]
    returns: NDArray[np.float64]
    sha256: str = ""

    def first(self, trajectories: int) -> Demonstrations:
        """Return the first n trajectories (§5.2.1, §6.3).

        Raises:
            UserError: n is below 1, or fewer are available.
        """
        available = len(self.lengths)
        if not 1 <= trajectories <= available:
            raise UserError(f"ablation.trajectories={trajectories}: must be within 1..{available}")
        transitions = int(self.lengths[:trajectories].sum())
        return Demonstrations(
            self.observations[: transitions + trajectories],
            self.actions[:transitions],
            self.lengths[:trajectories],
            self.returns[:trajectories],
            self.sha256,
        )

    def states(self, environment: Environment) -> StateTransitions:
        """Return the scaled pairs (s_t, s_{t+1}), without actions and returns."""
        return StateTransitions(*self._scaled_pairs(environment), len(self.lengths))

    def labeled(self, environment: Environment) -> LabeledTransitions:
        """Return the scaled pairs (s_t, s_{t+1}) with the expert's actions."""
        pairs = self._scaled_pairs(environment)
        return LabeledTransitions(*pairs, len(self.lengths), self.actions.copy())

    def _scaled_pairs(self, environment: Environment) -> tuple[Floats, Floats]:
        """Return (M, obs) scaled states s_t, and (M, obs) their successors s_{t+1}."""
        last = np.cumsum(self.lengths + 1) - 1
        is_last = np.zeros(len(self.observations), dtype=bool)
        is_last[last] = True
        scaled = environment.scale(self.observations)
        return scaled[~is_last], scaled[np.roll(~is_last, 1)]
