"""DQN₂: DQN with prioritized replay, double targets and dueling streams; see `dqn.py`."""

from dataclasses import replace

from ril.methods import dqn

SPEC = replace(dqn.SPEC, name="dqn_prioritized")
