"""Train GAIL on CartPole with the `imitation` package, to check `method=gail` against it.

Networks, optimizers, batches, scale and demonstrations are ril's; the algorithm is imitation's. The
script needs a virtual environment of its own, since imitation requires older libraries than ril.
Of its dependencies only tqdm is needed here. An empty module replaces tensorboard, which imitation
imports although nothing here uses it.

    python3 -m venv .venv-imitation
    .venv-imitation/bin/pip install --constraint constraints.txt torch
    .venv-imitation/bin/pip install --constraint constraints.txt --editable .
    .venv-imitation/bin/pip install --no-deps imitation==1.0.1 tqdm

    .venv-imitation/bin/python scripts/gail_by_imitation.py --trajectories 1 --output one.csv

A row is written as soon as its seed is finished. The same command resumes with the other seeds.
"""

from __future__ import annotations

import argparse
import csv
import sys
import time
from pathlib import Path
from tempfile import TemporaryDirectory
from types import ModuleType

sys.modules["torch.utils.tensorboard"] = ModuleType("torch.utils.tensorboard")

import numpy as np  # noqa: E402
import torch  # noqa: E402
from imitation.algorithms.adversarial.gail import GAIL  # noqa: E402
from imitation.data.types import Trajectory  # noqa: E402
from imitation.rewards.reward_nets import BasicRewardNet  # noqa: E402
from imitation.util import logger  # noqa: E402
from matched_dqn import composed, make_scaled  # noqa: E402
from stable_baselines3 import PPO  # noqa: E402
from stable_baselines3.common.env_util import make_vec_env  # noqa: E402
from stable_baselines3.common.evaluation import evaluate_policy  # noqa: E402

from ril.demonstrations.files import shipped_path  # noqa: E402
from ril.environments.environment import Environment, load_environment  # noqa: E402

COPIES, STEPS = 8, 128  # one rollout is 8 environments × 128 steps
ROLLOUT = COPIES * STEPS
QUARTERS = (25, 50, 75, 100)  # of the budget, in percent; policies are scored after each
EVALUATION_EPISODES, EVALUATION_COPIES = 100, 20
COLUMNS = (
    "seed",
    "trajectories",
    "total_timesteps",
    *(f"return_{percent}" for percent in QUARTERS),
    "seconds",  # of training, without evaluations
)


def load_trajectories(environment: Environment, count: int) -> list[Trajectory]:
    """Return the expert's first trajectories, scaled; the step limit truncated each of them."""
    with np.load(shipped_path("cartpole")) as file:
        observations, actions, lengths = file["observations"], file["actions"], file["lengths"]
    ends = np.cumsum(lengths)[:-1]
    return [
        Trajectory(environment.scale(states), chosen, infos=None, terminal=False)
        for states, chosen in zip(
            np.split(observations, ends + np.arange(1, len(lengths))),
            np.split(actions, ends),
            strict=True,
        )
    ][:count]


def train(
    environment: Environment, trajectories: list[Trajectory], total_timesteps: int, seed: int
) -> tuple[list[float], float]:
    """Train one seed.

    PPO also seeds the global generators of numpy and torch, from which imitation draws its batches.

    Args:
        environment: the environment to train in.
        trajectories: the expert's trajectories.
        total_timesteps: budget, a multiple of four rollouts.
        seed: of PPO, its networks and environments.

    Returns:
        The mean return of greedy episodes after each quarter of the budget, and the seconds of
        training.
    """
    venv = make_vec_env(lambda: make_scaled(environment), COPIES, seed=seed)
    ppo = PPO(
        "MlpPolicy",
        venv,
        n_steps=STEPS,
        batch_size=64,
        n_epochs=10,
        learning_rate=3e-4,
        gamma=0.99,
        gae_lambda=0.95,
        ent_coef=0.0,
        clip_range=0.2,
        policy_kwargs={"net_arch": [100, 100]},
        seed=seed,
        device="cpu",
    )
    discriminator = BasicRewardNet(
        venv.observation_space,
        venv.action_space,
        hid_sizes=(100, 100),
        activation=torch.nn.Tanh,
    )
    evaluation = make_vec_env(lambda: make_scaled(environment), EVALUATION_COPIES)
    every = total_timesteps // ROLLOUT // len(QUARTERS)
    returns: list[float] = []
    evaluating = 0.0

    def score(finished_round: int) -> None:
        nonlocal evaluating
        if (finished_round + 1) % every:
            return
        started = time.perf_counter()
        evaluation.seed(1000 * seed)  # the same initial states in every evaluation
        mean, _ = evaluate_policy(ppo, evaluation, EVALUATION_EPISODES, deterministic=True)
        returns.append(float(mean))
        evaluating += time.perf_counter() - started

    with TemporaryDirectory() as folder:
        gail = GAIL(
            demonstrations=trajectories,
            demo_batch_size=256,
            venv=venv,
            gen_algo=ppo,
            reward_net=discriminator,
            n_disc_updates_per_round=4,
            disc_opt_cls=torch.optim.Adam,
            disc_opt_kwargs={"lr": 1e-3},
            gen_train_timesteps=ROLLOUT,
            gen_replay_buffer_capacity=ROLLOUT,
            allow_variable_horizon=True,
            custom_logger=logger.configure(folder, format_strs=[]),
        )
        started = time.perf_counter()
        gail.train(total_timesteps, callback=score)
        seconds = time.perf_counter() - started - evaluating
    return returns, seconds


def main() -> None:
    """Train every seed that has no row yet, one after another."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--trajectories", type=int, default=1, help="of the expert, to train on")
    parser.add_argument("--total-timesteps", type=int, default=204_800, help="steps per seed")
    parser.add_argument("--seeds", type=int, nargs="+", default=list(range(100, 110)))
    parser.add_argument("--output", type=Path, required=True, help="CSV, a row per seed")
    arguments = parser.parse_args()
    if arguments.total_timesteps < 1 or arguments.total_timesteps % (len(QUARTERS) * ROLLOUT):
        parser.error(f"--total-timesteps: must be a multiple of {len(QUARTERS) * ROLLOUT}")

    torch.set_num_threads(1)
    environment = load_environment(composed("env=cartpole", "method=gail").env)
    trajectories = load_trajectories(environment, arguments.trajectories)
    if not 1 <= arguments.trajectories == len(trajectories):
        parser.error(f"--trajectories={arguments.trajectories}: must be within 1..100")

    done = set()
    if arguments.output.exists():
        with arguments.output.open(newline="") as file:
            done = {tuple(int(row[name]) for name in COLUMNS[:3]) for row in csv.DictReader(file)}
    with arguments.output.open("a", newline="") as file:
        writer = csv.writer(file)
        if file.tell() == 0:
            writer.writerow(COLUMNS)
        for seed in arguments.seeds:
            cell = (seed, arguments.trajectories, arguments.total_timesteps)
            if cell in done:
                continue
            returns, seconds = train(environment, trajectories, arguments.total_timesteps, seed)
            writer.writerow((*cell, *(f"{mean:.2f}" for mean in returns), f"{seconds:.1f}"))
            file.flush()


if __name__ == "__main__":
    main()
