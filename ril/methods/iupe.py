"""Imitating Unknown Policies via Exploration (Gavenski et al., 2020): RIL's imitation half."""

from __future__ import annotations

from ril.io.errors import UserError
from ril.learners.imitation import ImitationConfig, SelfSupervisedImitation
from ril.learners.topology import initial_policy
from ril.methods.ril import Algorithm1, cloning
from ril.methods.spec import EPSILON, INVERSE_DYNAMICS, MethodSpec
from ril.task import Task


def build(config: ImitationConfig, task: Task) -> Algorithm1:
    """Make IUPE: Algorithm 1 without line 13 and without eq. 2.

    Raises:
        UserError: `goal_sampler.upper_limit` is true.
    """
    if config.goal_sampler.upper_limit:
        raise UserError(
            "method.goal_sampler.upper_limit=true: IUPE has no eq. 2; "
            "use method=ril method.reinforcement=false"
        )
    policy = initial_policy(config.network, task)
    imitation = SelfSupervisedImitation(config, task, policy)
    return Algorithm1(config, task, policy, imitation, cloning(config, task, policy), None)


SPEC = MethodSpec(
    "iupe",
    ImitationConfig,
    build,
    expert="states",
    compiles=True,
    shown=(INVERSE_DYNAMICS, EPSILON),
)
