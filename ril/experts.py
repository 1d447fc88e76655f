"""`ril-expert`: train an expert to a wanted return and collect its trajectories.

The paper's experts are stopped at a return: 500, −85, −106 and 235.96 (Table 2), and lower ones
on purpose (§7, Table 9). So training here is checked every few thousand steps and ends once the
greedy policy's mean return lies within a tolerance of the target, above or below.
"""

from __future__ import annotations

import hashlib
import json
import math
import os
import platform
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from importlib.metadata import version
from pathlib import Path
from typing import Any

import hydra
import numpy as np
from hydra.core.hydra_config import HydraConfig
from hydra.errors import HydraException
from numpy.typing import NDArray
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn

from ril.config import EnvironmentConfig
from ril.demonstrations import Demonstrations
from ril.environments import Environment, Floats, load_environment
from ril.errors import UserError
from ril.paths import config_folder

EVALUATION_EPISODES = 100  # as many as AER is a mean of (§4)
Policy = Callable[[Floats], NDArray[np.integer]]  # (N, obs) raw observations -> (N,) actions
OnStep = Callable[[int, "float | None"], None]  # steps so far, mean return if just measured


@dataclass(frozen=True)
class ExpertConfig:
    """What `conf/expert.yaml` and its groups say; each key is explained there."""

    env: EnvironmentConfig
    algorithm: str
    ppo: dict[str, Any]
    dqn: dict[str, Any]
    target_return: float
    tolerance: float
    total_timesteps: int
    check_every: int
    episodes: int
    first_length: int | None
    seed: int
    output: str
    device: str

    @property
    def margin(self) -> float:
        """How far from `target_return` a mean may lie, in units of return."""
        return self.tolerance * max(1.0, abs(self.target_return))


@dataclass(frozen=True)
class Episode:
    """One greedy episode of T steps.

    Attributes:
        seed: what the environment was reset with.
        observations: (T + 1, obs) raw states.
        actions: (T,) actions.
        rewards: (T,) rewards.
        terminated: whether the environment ended it, rather than the step limit.
    """

    seed: int
    observations: Floats
    actions: NDArray[np.int64]
    rewards: Floats
    terminated: bool

    @property
    def total_reward(self) -> float:
        """The undiscounted return."""
        return float(self.rewards.sum(dtype=np.float64))


def play(environment: Environment, policy: Policy, seeds: Sequence[int]) -> list[Episode]:
    """Play one episode per reset seed, all side by side, in the order of the seeds."""
    copies = [environment.make() for _ in seeds]
    observations = [[env.reset(seed=seed)[0]] for env, seed in zip(copies, seeds, strict=True)]
    actions: list[list[int]] = [[] for _ in seeds]
    rewards: list[list[float]] = [[] for _ in seeds]
    terminated = [False] * len(seeds)
    running = list(range(len(seeds)))
    while running:
        chosen = policy(np.array([observations[i][-1] for i in running], dtype=np.float32))
        still = []
        for i, action in zip(running, chosen.tolist(), strict=True):
            observation, reward, terminated[i], truncated, _ = copies[i].step(action)
            observations[i].append(observation)
            actions[i].append(action)
            rewards[i].append(float(reward))
            if not (terminated[i] or truncated):
                still.append(i)
        running = still
    for env in copies:
        env.close()
    return [
        Episode(
            seed,
            np.array(observations[i], dtype=np.float32),
            np.array(actions[i], dtype=np.int64),
            np.array(rewards[i], dtype=np.float32),
            bool(terminated[i]),
        )
        for i, seed in enumerate(seeds)
    ]


def put_first(
    episodes: Sequence[Episode], first_length: int | None, minimum_return: float
) -> list[Episode]:
    """Move one episode to the front: the one that single-trajectory runs will see (Table 6).

    It is the one whose length is nearest `first_length` among those that return at least
    `minimum_return` (among all, if none does); of equally near ones the best, then the earliest.
    The others keep their order, as all do if `first_length` is None.
    """
    if first_length is None:
        return list(episodes)
    able = [e for e in episodes if e.total_reward >= minimum_return] or episodes
    first = min(able, key=lambda e: (abs(len(e.actions) - first_length), -e.total_reward))
    return [first, *(episode for episode in episodes if episode is not first)]


def train(
    config: ExpertConfig, environment: Environment, on_step: OnStep
) -> tuple[Policy, int, float]:
    """Train until the mean of 100 greedy episodes lies within the tolerance of the target.

    Returns:
        The greedy policy, the steps it was trained for, and the mean return that ended it.

    Raises:
        UserError: a hyperparameter is unknown or unfit, or the target is not reached.
    """
    from stable_baselines3 import DQN, PPO
    from stable_baselines3.common.vec_env import DummyVecEnv, VecEnv, VecNormalize

    given = dict(getattr(config, config.algorithm))
    n_envs, normalize = given.pop("n_envs", 1), given.pop("normalize", False)
    try:
        vec_env: VecEnv = DummyVecEnv([environment.make] * n_envs)
        if normalize:
            vec_env = VecNormalize(vec_env, gamma=given.get("gamma", 0.99))
        model = {"ppo": PPO, "dqn": DQN}[config.algorithm](
            "MlpPolicy",
            vec_env,
            seed=config.seed,
            device=config.device,
            **{key: _linear(key, value) for key, value in given.items()},
        )
    except (TypeError, ValueError, AssertionError, IndexError) as error:
        raise UserError(f"{config.algorithm}={given}: {error}") from None

    def policy(observations: Floats) -> NDArray[np.integer]:
        if isinstance(vec_env, VecNormalize):
            observations = np.asarray(vec_env.normalize_obs(observations))
        return model.predict(observations, deterministic=True)[0]

    evaluation_seeds, _ = _reset_seeds(config)
    means: list[tuple[int, float]] = []

    def check(_locals: dict[str, Any], _globals: dict[str, Any]) -> bool:
        """Whether to go on training."""
        steps = model.num_timesteps
        on_step(steps, None)
        if steps < (means[-1][0] if means else 0) + config.check_every:
            return True
        episodes = play(environment, policy, evaluation_seeds)
        means.append((steps, float(np.mean([e.total_reward for e in episodes]))))
        on_step(*means[-1])
        return abs(means[-1][1] - config.target_return) > config.margin

    model.learn(config.total_timesteps, callback=check)
    vec_env.close()
    if means and abs(means[-1][1] - config.target_return) <= config.margin:
        return policy, *means[-1]
    steps, nearest = min(
        means, key=lambda m: abs(m[1] - config.target_return), default=(0, math.nan)
    )
    raise UserError(
        f"target_return={config.target_return:g}: no mean within {config.margin:.3g} of it in "
        f"total_timesteps={config.total_timesteps} (nearest {nearest:.2f} at step {steps}); "
        "allow more steps, a smaller check_every, a larger tolerance or another seed"
    )


def make_expert(config: ExpertConfig, command: str, on_step: OnStep) -> dict[str, Any]:
    """Train, collect and write `<output>` and the `.json` beside it, which is returned.

    Raises:
        UserError: a value cannot be used, or the target is not reached; nothing is written.
    """
    import torch

    torch.set_num_threads(1)
    _check(config)
    environment = load_environment(config.env)
    started = time.monotonic()
    policy, steps, evaluation_mean = train(config, environment, on_step)
    _, collection_seeds = _reset_seeds(config)
    episodes = put_first(
        play(environment, policy, collection_seeds),
        config.first_length,
        config.target_return - config.margin,
    )
    demonstrations = Demonstrations(
        np.concatenate([e.observations for e in episodes]),
        np.concatenate([e.actions for e in episodes]),
        np.concatenate([e.rewards for e in episodes]),
        np.array([len(e.actions) for e in episodes], dtype=np.int64),
        np.array([e.terminated for e in episodes]),
    )
    record = {
        "command": command,
        "config": asdict(config),
        "versions": {
            "python": platform.python_version(),
            **{name: version(name) for name in ("torch", "stable-baselines3", "gymnasium")},
        },
        "seed": config.seed,
        "steps_trained": steps,
        "evaluation_mean_return": evaluation_mean,
        "episodes": len(episodes),
        "transitions": len(demonstrations.actions),
        "returns": _summary([e.total_reward for e in episodes]),
        "lengths": _summary([len(e.actions) for e in episodes]),
        "first": {
            "length": len(episodes[0].actions),
            "return": episodes[0].total_reward,
            "collected_as": collection_seeds.index(episodes[0].seed),
        },
        "reset_seeds": [e.seed for e in episodes],
        "wall_seconds": round(time.monotonic() - started, 1),
    }
    return _write(demonstrations, record, Path(config.output))


def _linear(key: str, value: Any) -> Any:
    """`lin_0.001` as RL Zoo means it: a value that falls linearly to 0 over the training."""
    if not (isinstance(value, str) and value.startswith("lin_")):
        return value
    try:
        start = float(value.removeprefix("lin_"))
    except ValueError:
        raise UserError(f"{key}={value}: must be a number or lin_<number>") from None
    return lambda remaining: start * remaining


def _reset_seeds(config: ExpertConfig) -> tuple[list[int], list[int]]:
    """Reset seeds of the evaluation's and of the collected episodes; training sees neither."""
    evaluation, collection = np.random.SeedSequence(config.seed).spawn(2)
    return (
        evaluation.generate_state(EVALUATION_EPISODES).tolist(),
        collection.generate_state(config.episodes).tolist(),
    )


def _summary(values: Sequence[float]) -> dict[str, float]:
    return {
        "mean": float(np.mean(values)),
        "std": float(np.std(values)),
        "min": float(np.min(values)),
        "max": float(np.max(values)),
    }


def _check(config: ExpertConfig) -> None:
    """Refuse what cannot work before anything is trained."""
    import torch

    output = Path(config.output)
    existing = next(folder for folder in output.absolute().parents if folder.exists())
    for key, fine, allowed in (
        ("algorithm", config.algorithm in ("ppo", "dqn"), "ppo or dqn"),
        ("target_return", math.isfinite(config.target_return), "a finite number"),
        ("tolerance", 0 < config.tolerance < math.inf, "a number above 0, such as 0.03"),
        ("total_timesteps", config.total_timesteps >= 1, "1 or more"),
        ("check_every", config.check_every >= 1, "1 or more"),
        ("episodes", config.episodes >= 1, "1 or more"),
        ("first_length", config.first_length is None or config.first_length >= 1, "null or >= 1"),
        ("seed", 0 <= config.seed < 2**32, "within 0..4294967295"),
        ("output", output.suffix == ".npz" and not output.is_dir(), "a file named *.npz"),
        ("output", existing.is_dir() and os.access(existing, os.W_OK), "in a writable folder"),
    ):
        if not fine:
            raise UserError(f"{key}={getattr(config, key)}: must be {allowed}")
    try:
        torch.zeros(1, device=config.device)
    except (RuntimeError, AssertionError):
        raise UserError(f"device={config.device}: not a device torch can use here") from None


def _write(demonstrations: Demonstrations, record: dict[str, Any], output: Path) -> dict[str, Any]:
    """Write both files under temporary names, then rename them into place."""
    described = output.with_suffix(".json")
    arrays, text = (path.with_name(f".{os.getpid()}-{path.name}") for path in (output, described))
    try:
        output.parent.mkdir(parents=True, exist_ok=True)
        demonstrations.save(arrays)
        record = {"sha256": hashlib.sha256(arrays.read_bytes()).hexdigest(), **record}
        text.write_text(json.dumps(record, indent=2) + "\n", encoding="utf-8")
        arrays.replace(output)
        text.replace(described)
    except OSError as error:
        raise UserError(f"output={output}: cannot be written ({error.strerror})") from None
    finally:
        arrays.unlink(missing_ok=True)
        text.unlink(missing_ok=True)
    return record


@contextmanager
def _progress(config: ExpertConfig, console: Console) -> Iterator[OnStep]:
    """A bar on a terminal; a line per evaluation elsewhere, such as in a log file."""
    columns = (
        TextColumn("{task.description}"),
        BarColumn(),
        MofNCompleteColumn(),
        TextColumn("steps, mean return {task.fields[mean]}"),
        TimeElapsedColumn(),
    )
    started = time.monotonic()
    with Progress(*columns, console=console, disable=not console.is_terminal) as bar:
        task = bar.add_task(config.env.name, total=config.total_timesteps, mean="…")

        def on_step(steps: int, mean: float | None) -> None:
            bar.update(task, completed=steps)
            if mean is None:
                return
            bar.update(task, mean=f"{mean:.2f}")
            if not console.is_terminal:
                elapsed = time.monotonic() - started
                console.print(f"{steps:>9,} steps  mean return {mean:.2f}  {elapsed:.0f} s")

        yield on_step


def _run(raw: DictConfig) -> None:
    try:
        for key in sorted(OmegaConf.missing_keys(raw)):
            raise UserError(f"{key}=???: must be given")
        schema = OmegaConf.structured(ExpertConfig)
        OmegaConf.set_readonly(schema, None)  # frozen dataclasses may not be merged into
        schema.env = OmegaConf.structured(EnvironmentConfig)
        OmegaConf.set_readonly(schema.env, None)
        OmegaConf.set_readonly(schema.env.goal, None)
        config: ExpertConfig = OmegaConf.to_object(OmegaConf.merge(schema, raw))  # type: ignore[assignment]
        console = Console(highlight=False)
        command = " ".join(["ril-expert", *HydraConfig.get().overrides.task])
        with _progress(config, console) as on_step:
            record = make_expert(config, command, on_step)
    except (UserError, OmegaConfBaseException) as error:
        _refuse(error)
    returns, first = record["returns"], record["first"]
    console.print(
        f"{config.output}: {record['episodes']} episodes, return {returns['mean']:.2f} ± "
        f"{returns['std']:.2f} after {record['steps_trained']:,} steps; the first has length "
        f"{first['length']} and return {first['return']:.2f}",
        soft_wrap=True,
    )


def _refuse(error: Exception) -> None:
    """Say in one line what was wrong, and leave."""
    sys.exit(f"ril-expert: {' '.join(str(error).split())}")


def main() -> None:
    """The console command; exit status 1 and one line on stderr for a mistake of the user's."""
    os.environ["HYDRA_FULL_ERROR"] = "1"  # let Hydra's own errors come through to here
    folder = str(config_folder())
    try:
        hydra.main(version_base="1.3", config_path=folder, config_name="expert")(_run)()
    except (HydraException, OmegaConfBaseException) as error:
        _refuse(error)
    except KeyboardInterrupt:
        sys.exit(130)


if __name__ == "__main__":
    main()
