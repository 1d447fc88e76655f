"""Expert trajectories, cut to the first n and handed on with or without the expert's actions."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ril.environments import Environment, Floats
from ril.io.errors import UserError


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

    @classmethod
    def none(cls, environment: Environment) -> StateTransitions:
        """What a method sees that is shown no expert."""
        nothing = np.zeros((0, environment.observation_size), dtype=np.float32)
        return cls(nothing, nothing, trajectories=0)

    @property
    def mean_length(self) -> float:
        """Transitions per trajectory, which sets the replay memory's size (§3.4)."""
        return len(self.observations) / self.trajectories


@dataclass(frozen=True)
class LabelledTransitions(StateTransitions):
    """What a method with access to the ground truth sees besides: the expert's actions.

    Attributes:
        actions: (M,) taken in the states s_t.
    """

    actions: NDArray[np.int64]


@dataclass(frozen=True)
class Demonstrations:
    """Trajectories of one expert.

    Attributes:
        observations: (M + E, obs) raw states; a trajectory of length T has T + 1 of them.
        actions: (M,) the expert's actions.
        lengths: (E,) transitions of each trajectory; they sum to M.
        returns: (E,) undiscounted return of each trajectory.
        sha256: of the file.
    """

    observations: Floats
    actions: NDArray[np.int64]
    lengths: NDArray[np.int64]
    returns: NDArray[np.float64]
    sha256: str = ""

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
            self.lengths[:trajectories],
            self.returns[:trajectories],
            self.sha256,
        )

    def states(self, environment: Environment) -> StateTransitions:
        """The state-only view (s_t, s_{t+1}), scaled; actions and returns stay behind."""
        return StateTransitions(*self._scaled_pairs(environment), len(self.lengths))

    def labelled(self, environment: Environment) -> LabelledTransitions:
        """The same view, scaled, with the expert's actions."""
        pairs = self._scaled_pairs(environment)
        return LabelledTransitions(*pairs, len(self.lengths), self.actions.copy())

    def _scaled_pairs(self, environment: Environment) -> tuple[Floats, Floats]:
        """(M, obs) scaled states s_t, and their s_{t+1}."""
        last = np.cumsum(self.lengths + 1) - 1
        is_last = np.zeros(len(self.observations), dtype=bool)
        is_last[last] = True
        scaled = environment.scale(self.observations)
        return scaled[~is_last], scaled[np.roll(~is_last, 1)]
