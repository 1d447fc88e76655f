"""The specification of a method: what ril must know about it before it is trained."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from ril.config.schema import MethodConfig
from ril.demonstrations.trajectories import Demonstrations, StateTransitions
from ril.environments.environment import Environment
from ril.methods.base import Method
from ril.task import Task

#: A function from (environment, demonstrations, seeds, episodes) to returns (S, episodes).
Measure = Callable[[Environment, Demonstrations, list[int], int], NDArray[np.float64]]


@dataclass(frozen=True)
class Shown:
    """A diagnostic that the display shows during training.

    Attributes:
        label: its name on the display.
        metric: its name in `Progress.metrics`.
        form: format specification for its mean over seeds.
    """

    label: str
    metric: str
    form: str = ".4g"


TD_LOSS = Shown("TD loss", "td_loss")
EPSILON = Shown("ε", "epsilon", ".3f")
INVERSE_DYNAMICS = Shown("inverse dynamics", "inverse_dynamics_accuracy", ".0%")


@dataclass(frozen=True)
class MethodSpec:
    """The specification of one method, which is `SPEC` in the method's file.

    Attributes:
        name: the value of `method=`, and the name of its Python, YAML and documentation files.
        config: dataclass of the keys below `method`.
        build: makes the method; None for a reference, which learns nothing.
        measure: measures the returns of a reference; None for a method.
        expert: the part of the expert's trajectories that it is given.
        budget: the key of `method` that sets the length of training; "" for a reference.
        uses_equation_2: whether k and n can change its numbers.
        compiles: whether `compile` can change the last bits of its numbers.
        shown: diagnostics for the display.
    """

    name: str
    config: type[MethodConfig]
    build: Callable[[Any, Task], Method] | None = None
    measure: Measure | None = None
    expert: Literal["nothing", "states", "states and actions"] = "nothing"
    budget: Literal["epochs", "total_timesteps", ""] = "epochs"
    uses_equation_2: bool = False
    compiles: bool = False
    shown: tuple[Shown, ...] = ()

    @property
    def idle_ablations(self) -> tuple[str, ...]:
        """The keys of `ablation` that cannot change the method's numbers."""
        eq_2 = () if self.uses_equation_2 else ("k", "n")
        return eq_2 if self.expert != "nothing" else (*eq_2, "trajectories")

    def view(self, expert: Demonstrations, environment: Environment) -> StateTransitions:
        """Return the part of the expert's trajectories that the method is given."""
        if self.expert == "nothing":
            return StateTransitions.none(environment)
        if self.expert == "states":
            return expert.states(environment)
        return expert.labeled(environment)
