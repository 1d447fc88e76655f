"""What a run is asked to do: one dataclass per group of `conf/`, which holds all the values."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

from omegaconf import MISSING


@dataclass
class GoalConfig:
    """When an episode counts as having reached the goal; every condition that is set must hold."""

    minimum_return: float | None = None
    minimum_final_reward: float | None = None
    terminated: bool | None = None


@dataclass
class EnvironmentConfig:
    """`conf/env/*.yaml`: a Gymnasium environment."""

    name: str = MISSING
    id: str = MISSING
    solved_return: float | None = None
    goal: GoalConfig = field(default_factory=GoalConfig)
    observation_low: list[float] | None = None
    observation_high: list[float] | None = None
    kwargs: dict[str, Any] = field(default_factory=dict)
    vectorized: bool = True


@dataclass
class NetworkConfig:
    """The topology that policy and inverse dynamics model share (§4.1)."""

    hidden: list[int] = MISSING
    attention: bool = MISSING
    layer_norm: bool = MISSING
    negative_slope: float = MISSING


@dataclass
class InverseDynamicsConfig:
    """M_θ, its training (Alg. 1, line 7) and its labels (line 8)."""

    inputs: str = MISSING
    standardise: Any = MISSING  # change, or all inputs: true or false
    learning_rate: float = MISSING
    updates: int = MISSING
    batch_size: int = MISSING
    gradient_clip: float | None = MISSING
    labels: str = MISSING


@dataclass
class CloningConfig:
    """π_φ's imitation half (Alg. 1, line 9)."""

    learning_rate: float = MISSING
    updates: int = MISSING
    batch_size: int = MISSING
    gradient_clip: float | None = MISSING


@dataclass
class TemporalDifferenceConfig:
    """Q-learning from replay (eq. 1)."""

    learning_rate: float = MISSING
    updates: int = MISSING
    batch_size: int = MISSING
    gradient_clip: float | None = MISSING
    discount: float = MISSING
    loss: str = MISSING


@dataclass
class TargetNetworkConfig(TemporalDifferenceConfig):
    """With a target network that is copied from time to time."""

    target_interval: int = MISSING


@dataclass
class QLearningConfig(TargetNetworkConfig):
    """π_φ's reinforcement half (Alg. 1, line 13)."""

    replay_trajectories: float = MISSING


@dataclass
class ConsistencyConfig(TemporalDifferenceConfig):
    """Both halves in one descent, of `ril_consistent`."""

    anneal: bool = MISSING
    n_steps: int = MISSING
    tau: float = MISSING
    value_hidden: list[int] = MISSING
    value_scale: float = MISSING
    temperature: float = MISSING
    gap: float | None = MISSING
    imitation_weight: float = MISSING
    min_confidence: float = MISSING
    fade: bool = MISSING
    replay_trajectories: float = MISSING
    replay_recent: float | None = MISSING


@dataclass
class ReplayConfig:
    """What is remembered, and what is drawn of it."""

    capacity: int | None = MISSING
    alpha: float = MISSING
    beta: float = MISSING


@dataclass
class OnlineQLearningConfig(TargetNetworkConfig):
    """Q-learning while acting, for a number of steps."""

    double: bool = MISSING
    train_freq: int = MISSING
    learning_starts: int = MISSING
    replay: ReplayConfig = field(default_factory=ReplayConfig)


@dataclass
class ExplorationConfig:
    """ε and what exploring means (§3.4)."""

    epsilon: float | None = MISSING
    kind: str = MISSING


@dataclass
class GoalSamplerConfig:
    """Line 14: where I^s comes from."""

    pre_steps_per_action: int = MISSING
    memory: str = MISSING
    upper_limit: bool = MISSING
    keep_pre: bool = MISSING


@dataclass
class StoppingConfig:
    """How long π_φ counts as improving (Alg. 1, line 6; §3.4, step vii)."""

    patience: int | None = MISSING
    loss_tolerance: float = MISSING


@dataclass
class MethodConfig:
    """What every method has; all that `random` and `expert` have."""

    name: str = MISSING


@dataclass
class BCConfig(MethodConfig):
    """`conf/method/bc.yaml`: behavioural cloning."""

    epochs: int = MISSING
    network: NetworkConfig = field(default_factory=NetworkConfig)
    cloning: CloningConfig = field(default_factory=CloningConfig)


@dataclass
class IUPEConfig(BCConfig):
    """`conf/method/iupe.yaml`: the imitation half of RIL."""

    episodes: int = MISSING
    inverse_dynamics: InverseDynamicsConfig = field(default_factory=InverseDynamicsConfig)
    exploration: ExplorationConfig = field(default_factory=ExplorationConfig)
    goal_sampler: GoalSamplerConfig = field(default_factory=GoalSamplerConfig)
    stopping: StoppingConfig = field(default_factory=StoppingConfig)


@dataclass
class HalvesConfig(IUPEConfig):
    """Imitation and reinforcement, either of which may be left out."""

    imitation: bool = MISSING
    reinforcement: bool = MISSING


@dataclass
class RILConfig(HalvesConfig):
    """`conf/method/ril.yaml`: Reinforced Imitation Learning."""

    q_learning: QLearningConfig = field(default_factory=QLearningConfig)


@dataclass
class RILConsistentConfig(HalvesConfig):
    """`conf/method/ril_consistent.yaml`: its halves in one consistent loss."""

    q_learning: ConsistencyConfig = field(default_factory=ConsistencyConfig)


@dataclass
class RILSequentialConfig(IUPEConfig):
    """`conf/method/ril_sequential.yaml`: RIL's halves one after the other."""

    total_timesteps: int = MISSING
    q_learning: OnlineQLearningConfig = field(default_factory=OnlineQLearningConfig)


@dataclass
class LatentPolicyConfig:
    """ILPO's first step: a policy over latent actions, and what each of them does."""

    encoder: list[int] = MISSING
    generator: int = MISSING
    latents: int | None = MISSING
    changes: str = MISSING
    negative_slope: float = MISSING
    learning_rate: float = MISSING
    beta1: float = MISSING
    updates: int = MISSING
    batch_size: int = MISSING


@dataclass
class RemappingConfig:
    """ILPO's second step: which action a latent one is."""

    hidden: list[int] = MISSING
    learning_rate: float = MISSING
    batch_size: int = MISSING
    steps: int = MISSING
    steps_per_epoch: int = MISSING
    epsilon: float = MISSING


@dataclass
class ILPOConfig(MethodConfig):
    """`conf/method/ilpo.yaml`: imitating latent policies from observation."""

    epochs: int = MISSING
    latent_policy: LatentPolicyConfig = field(default_factory=LatentPolicyConfig)
    remapping: RemappingConfig = field(default_factory=RemappingConfig)


@dataclass
class DiscriminatorConfig:
    """GAIL's discriminator, and what it pays."""

    hidden: list[int] = MISSING
    learning_rate: float = MISSING
    updates: int = MISSING
    batch_size: int = MISSING
    reward: str = MISSING


@dataclass
class PPOConfig:
    """Stable-Baselines3's PPO, by its own names; `hidden` of policy and value function each."""

    hidden: list[int] = MISSING
    n_envs: int = MISSING
    n_steps: int = MISSING
    batch_size: int = MISSING
    n_epochs: int = MISSING
    learning_rate: float = MISSING
    gamma: float = MISSING
    gae_lambda: float = MISSING
    clip_range: float = MISSING
    ent_coef: float = MISSING


@dataclass
class GAILConfig(MethodConfig):
    """`conf/method/gail.yaml`: generative adversarial imitation learning."""

    total_timesteps: int = MISSING
    discriminator: DiscriminatorConfig = field(default_factory=DiscriminatorConfig)
    ppo: PPOConfig = field(default_factory=PPOConfig)


@dataclass
class ReinforcementConfig(MethodConfig):
    """What methods have that learn by rewards alone, and never see the expert."""

    total_timesteps: int = MISSING


@dataclass
class LinearExplorationConfig:
    """ε, as it falls along a straight line and then stays."""

    initial_epsilon: float = MISSING
    final_epsilon: float = MISSING
    steps: int = MISSING


@dataclass
class DQNConfig(ReinforcementConfig):
    """`conf/method/dqn.yaml` and `dqn_prioritized.yaml`: deep Q-networks."""

    network: NetworkConfig = field(default_factory=NetworkConfig)
    dueling: bool = MISSING
    q_learning: OnlineQLearningConfig = field(default_factory=OnlineQLearningConfig)
    exploration: LinearExplorationConfig = field(default_factory=LinearExplorationConfig)


@dataclass
class KFACConfig:
    """Steps of K-FAC within a trust region; of ACKTR's actor or its critic."""

    learning_rate: float = MISSING
    kl_clip: float = MISSING
    momentum: float = MISSING
    damping: float = MISSING
    stats_decay: float = MISSING
    eigen_interval: int = MISSING


@dataclass
class ACKTRConfig(ReinforcementConfig):
    """`conf/method/acktr.yaml`: actor-critic with K-FAC; Stable-Baselines' names."""

    hidden: list[int] = MISSING
    n_envs: int = MISSING
    n_steps: int = MISSING
    standardise_steps: int = MISSING
    gamma: float = MISSING
    gae_lambda: float = MISSING
    ent_coef: float = MISSING
    actor: KFACConfig = field(default_factory=KFACConfig)
    critic: KFACConfig = field(default_factory=KFACConfig)


@dataclass
class ScheduledPPOConfig(PPOConfig):
    """With what RL Baselines3 Zoo adds to it."""

    normalize: bool = MISSING
    linear_schedule: bool = MISSING


@dataclass
class PPOMethodConfig(ReinforcementConfig):
    """`conf/method/ppo.yaml`: proximal policy optimisation."""

    ppo: ScheduledPPOConfig = field(default_factory=ScheduledPPOConfig)


#: What `conf/method/<name>.yaml` may say.
METHOD_CONFIGS: dict[str, type[MethodConfig]] = {
    "random": MethodConfig,
    "expert": MethodConfig,
    "acktr": ACKTRConfig,
    "bc": BCConfig,
    "dqn": DQNConfig,
    "dqn_prioritized": DQNConfig,
    "gail": GAILConfig,
    "ilpo": ILPOConfig,
    "iupe": IUPEConfig,
    "ppo": PPOMethodConfig,
    "ril": RILConfig,
    "ril_consistent": RILConsistentConfig,
    "ril_sequential": RILSequentialConfig,
}


@dataclass
class AblationConfig:
    """What the paper varies (§6.3, §6.4, §7)."""

    k: float = MISSING
    n: float = MISSING
    trajectories: int = MISSING
    expert_return: float | None = None


@dataclass
class EvaluationConfig:
    """How a policy is scored."""

    episodes: int = MISSING
    every: Any = MISSING
    selection_episodes: int = MISSING


@dataclass
class Config:
    """One run: one cell of one table."""

    env: EnvironmentConfig = field(default_factory=EnvironmentConfig)
    method: MethodConfig = field(default_factory=MethodConfig)
    ablation: AblationConfig = field(default_factory=AblationConfig)
    evaluation: EvaluationConfig = field(default_factory=EvaluationConfig)
    seeds: Any = MISSING
    demonstrations: str | None = None
    output_dir: str = MISSING
    processes: int | None = None
    device: str = MISSING
    compile: Any = MISSING
    resume: bool = MISSING
    logging: Any = None
