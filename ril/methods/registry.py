"""The methods by name; each is imported only when it runs."""

from __future__ import annotations

import importlib
from collections.abc import Callable
from dataclasses import dataclass

from ril.config.schema import MethodConfig
from ril.demonstrations.trajectories import Demonstrations, StateTransitions
from ril.environments import Environment
from ril.methods.base import Method
from ril.task import Task


@dataclass(frozen=True)
class Entry:
    """A method's place, and what it is shown of the expert.

    Attributes:
        path: module and class.
        sees_expert: whether it learns from the expert at all.
        sees_actions: whether the expert's actions are among what it sees; states always are.
    """

    path: str
    sees_expert: bool = True
    sees_actions: bool = False

    def load(self) -> Callable[[MethodConfig, Task], Method]:
        """The class."""
        module, name = self.path.split(":")
        method: Callable[[MethodConfig, Task], Method] = getattr(
            importlib.import_module(module), name
        )
        return method

    def shown(self, expert: Demonstrations, environment: Environment) -> StateTransitions:
        """What it may see of an expert."""
        if not self.sees_expert:
            return StateTransitions.none(environment)
        return expert.labelled(environment) if self.sees_actions else expert.states(environment)


METHODS = {
    "acktr": Entry("ril.methods.acktr:ACKTR", sees_expert=False),
    "bc": Entry("ril.methods.bc:BC", sees_actions=True),
    "dqn": Entry("ril.methods.dqn:DQN", sees_expert=False),
    "dqn_prioritized": Entry("ril.methods.dqn:DQN", sees_expert=False),
    "gail": Entry("ril.methods.gail:GAIL", sees_actions=True),
    "ilpo": Entry("ril.methods.ilpo:ILPO"),
    "iupe": Entry("ril.methods.iupe:IUPE"),
    "ppo": Entry("ril.methods.ppo:PPO", sees_expert=False),
    "ril": Entry("ril.methods.ril:RIL"),
    "ril_consistent": Entry("ril.methods.ril_consistent:ConsistentRIL"),
    "ril_sequential": Entry("ril.methods.ril_sequential:SequentialRIL"),
}
