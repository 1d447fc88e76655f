"""The methods by name; each is imported only when it runs."""

from __future__ import annotations

import importlib
from collections.abc import Callable
from dataclasses import dataclass

from ril.demonstrations.trajectories import Demonstrations, StateTransitions
from ril.environments import Environment
from ril.methods.base import Method
from ril.schema import MethodConfig
from ril.task import Task


@dataclass(frozen=True)
class Entry:
    """A method's place, and what it is shown of the expert.

    Attributes:
        path: module and class.
        sees_actions: whether the expert's actions are among it; states always are.
    """

    path: str
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
        return expert.labelled(environment) if self.sees_actions else expert.states(environment)


METHODS = {
    "bc": Entry("ril.methods.bc:BC", sees_actions=True),
    "gail": Entry("ril.methods.gail:GAIL", sees_actions=True),
    "ilpo": Entry("ril.methods.ilpo:ILPO"),
    "iupe": Entry("ril.methods.iupe:IUPE"),
    "ril": Entry("ril.methods.ril:RIL"),
}
