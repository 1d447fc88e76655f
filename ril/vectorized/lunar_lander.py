"""LunarLander-v3 with discrete actions and without wind, bit-identical to Gymnasium's."""

from __future__ import annotations

import math
from typing import Any, cast

import numpy as np
from gymnasium.envs.box2d import lunar_lander as constants

from ril.environments.environment import Environment, Floats, Integers
from ril.vectorized.copies import Outcome

_SCALE = constants.SCALE
_MAIN = constants.MAIN_ENGINE_Y_LOCATION / _SCALE
_HALF_WIDTH = constants.VIEWPORT_W / _SCALE / 2
_HALF_HEIGHT = constants.VIEWPORT_H / _SCALE / 2
_MAIN_ENGINE = 2  # the action; 1 and 3 are the engines at the left and right


class LanderCopies:
    """K copies of LunarLander, stepped one after another.

    Box2D's own step remains. Gymnasium's Python around it is replaced, which took half of the time:
    its wrappers, and what only wind, continuous actions and drawing need.

    Args:
        environment: LunarLander-v3 without keyword arguments.
        count: K.
    """

    def __init__(self, environment: Environment, count: int) -> None:
        limit = environment.max_episode_steps
        self._landers = [
            _Lander(cast(Any, environment.make().unwrapped), limit) for _ in range(count)
        ]
        self._limit = limit
        self._steps = np.zeros(count, dtype=np.int64)
        self.observations = np.zeros((count, environment.observation_size), dtype=np.float32)

    def reset(self, index: int, seed: int) -> None:
        """Begin an episode in one copy."""
        self.observations[index] = self._landers[index].reset(seed)
        self._steps[index] = 0

    def step(self, indices: Integers, actions: Integers) -> Outcome:
        """Take actions (C,) in the copies at indices (C,)."""
        outcomes = [
            self._landers[index].step(action)
            for index, action in zip(indices.tolist(), actions.tolist(), strict=True)
        ]
        observations, rewards, terminated = zip(*outcomes, strict=True)
        self.observations[indices] = observations
        self._steps[indices] += 1
        truncated = self._steps[indices] >= self._limit
        return np.array(rewards, dtype=np.float32), np.array(terminated, dtype=bool), truncated


class _Lander:
    """One copy.

    Args:
        env: Gymnasium's environment, without wrappers.
        limit: steps after which an episode is truncated.
    """

    def __init__(self, env: Any, limit: int) -> None:
        self._env = env
        self._limit = limit

    def reset(self, seed: int) -> Floats:
        """Begin an episode, and return its first observation (8,)."""
        env = self._env
        observation: Floats = env.reset(seed=seed)[0]
        # Gymnasium draws two numbers at each step: all of them at once are the same numbers.
        drawn = -1.0 + 2.0 * env.np_random.random(2 * self._limit)
        self._dispersions = iter((drawn / _SCALE).tolist())
        self._body, self._legs, self._world = env.lander, env.legs, env.world
        self._ground = env.helipad_y + constants.LEG_DOWN / _SCALE
        self._shaping: float = env.prev_shaping
        return observation

    def step(self, action: int) -> tuple[tuple[float, ...], float, bool]:
        """Take an action as `LunarLander.step` does, with its operations in its order.

        Returns:
            The observation (8,), the reward, and whether the environment ended the episode.
        """
        body = self._body
        along, across = next(self._dispersions), next(self._dispersions)
        fuel = 0.0
        if action == _MAIN_ENGINE:
            self._fire_main_engine(along, across)
            fuel = 0.30
        elif action:
            self._fire_side_engine(action - 2, along, across)
            fuel = 0.03
        self._world.Step(1.0 / constants.FPS, 6 * 30, 2 * 30)

        position, velocity, angle = body.position, body.linearVelocity, body.angle
        x = (position.x - _HALF_WIDTH) / _HALF_WIDTH
        y = (position.y - self._ground) / _HALF_HEIGHT
        x_dot = velocity.x * _HALF_WIDTH / constants.FPS
        y_dot = velocity.y * _HALF_HEIGHT / constants.FPS
        angle_dot = 20.0 * body.angularVelocity / constants.FPS
        left, right = (1.0 if leg.ground_contact else 0.0 for leg in self._legs)
        shaping = (
            -100 * math.sqrt(x * x + y * y)
            - 100 * math.sqrt(x_dot * x_dot + y_dot * y_dot)
            - 100 * abs(angle)
            + 10 * left
            + 10 * right
        )
        reward = shaping - self._shaping - fuel
        self._shaping = shaping
        terminated = False
        if self._env.game_over or abs(x) >= 1.0:
            terminated, reward = True, -100.0
        if not body.awake:
            terminated, reward = True, 100.0
        return (x, y, x_dot, y_dot, angle, angle_dot, left, right), reward, terminated

    def _fire_main_engine(self, along: float, across: float) -> None:
        """Push from below, along the body and a little aside."""
        body, position = self._body, self._body.position
        sine, cosine = math.sin(body.angle), math.cos(body.angle)
        distance = _MAIN + 2 * along
        x = sine * distance - cosine * across
        y = -cosine * distance - sine * across
        power = constants.MAIN_ENGINE_POWER
        body.ApplyLinearImpulse((-x * power, -y * power), (position.x + x, position.y + y), True)

    def _fire_side_engine(self, direction: int, along: float, across: float) -> None:
        """Push from the left (−1) or from the right (1)."""
        body, position = self._body, self._body.position
        sine, cosine = math.sin(body.angle), math.cos(body.angle)
        distance = 3 * across + direction * constants.SIDE_ENGINE_AWAY / _SCALE
        x = sine * along - cosine * distance
        y = -cosine * along - sine * distance
        power = constants.SIDE_ENGINE_POWER
        at_x = position.x + x - sine * 17 / _SCALE
        at_y = position.y + y + cosine * constants.SIDE_ENGINE_HEIGHT / _SCALE
        body.ApplyLinearImpulse((-x * power, -y * power), (at_x, at_y), True)
