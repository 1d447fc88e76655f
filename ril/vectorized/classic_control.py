"""Gymnasium's classic control environments for K copies at once, bit-identical to Gymnasium's.

Each function is `step` of one environment. Its arguments are Gymnasium's own environment, which
holds the constants, the states (n, K) and the actions (K,). It returns the next states (n, K), the
next observations (obs, K), the rewards (K,) and whether the environment ended the episodes (K,).
"""

from __future__ import annotations

import math
from collections.abc import Callable
from itertools import repeat
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ril.environments.environment import Integers

States = NDArray[np.float64]
Ends = NDArray[np.bool_]
Step = Callable[[Any, States, Integers], tuple[States, States, States, Ends]]


def cartpole(env: Any, states: States, actions: Integers) -> tuple[States, States, States, Ends]:
    """Step CartPole as `CartPoleEnv.step` does, by Euler's method."""
    _, x_dot, theta, theta_dot = states
    force = np.where(actions == 1, env.force_mag, -env.force_mag)
    costheta, sintheta = np.cos(theta), np.sin(theta)
    temp = (force + env.polemass_length * np.square(theta_dot) * sintheta) / env.total_mass
    thetaacc = (env.gravity * sintheta - costheta * temp) / (
        env.length * (4.0 / 3.0 - env.masspole * np.square(costheta) / env.total_mass)
    )
    xacc = temp - env.polemass_length * thetaacc * costheta / env.total_mass
    following = states + env.tau * np.stack((x_dot, xacc, theta_dot, thetaacc))
    beyond_x = np.abs(following[0]) > env.x_threshold
    ends = beyond_x | (np.abs(following[2]) > env.theta_threshold_radians)
    return following, following, np.ones(len(actions)), ends


def mountaincar(env: Any, states: States, actions: Integers) -> tuple[States, States, States, Ends]:
    """Step MountainCar as `MountainCarEnv.step` does."""
    position, velocity = states
    # As in Gymnasium, the cosine is math's: NumPy's may differ from it in the last bit.
    slope = np.fromiter(map(math.cos, (3 * position).tolist()), float, len(position))
    velocity = velocity + ((actions - 1) * env.force + slope * -env.gravity)
    velocity = np.minimum(np.maximum(velocity, -env.max_speed), env.max_speed)
    position = np.minimum(np.maximum(position + velocity, env.min_position), env.max_position)
    velocity[(position == env.min_position) & (velocity < 0)] = 0
    ends = (position >= env.goal_position) & (velocity >= env.goal_velocity)
    following = np.stack((position, velocity))
    return following, following, np.full(len(actions), -1.0), ends


def acrobot(env: Any, states: States, actions: Integers) -> tuple[States, States, States, Ends]:
    """Step Acrobot as `AcrobotEnv.step` does: by Runge-Kutta, with "the book's" dynamics."""
    torque = np.array(env.AVAIL_TORQUE)[actions]
    half = env.dt / 2.0
    k1 = _acrobot_slope(env, states, torque)
    k2 = _acrobot_slope(env, states + half * k1, torque)
    k3 = _acrobot_slope(env, states + half * k2, torque)
    k4 = _acrobot_slope(env, states + env.dt * k3, torque)
    following = states + env.dt / 6.0 * (k1 + 2 * k2 + 2 * k3 + k4)
    angles, speeds = following[:2], following[2:]
    while (over := angles > np.pi).any():
        angles[over] -= 2 * np.pi
    while (under := angles < -np.pi).any():
        angles[under] += 2 * np.pi
    fastest = np.array([[env.MAX_VEL_1], [env.MAX_VEL_2]])
    np.minimum(np.maximum(speeds, -fastest), fastest, out=speeds)
    cos, sin = np.cos(angles), np.sin(angles)
    ends = -cos[0] - np.cos(angles[1] + angles[0]) > 1.0
    observations = np.stack((cos[0], sin[0], cos[1], sin[1], *speeds))
    return following, observations, np.where(ends, 0.0, -1.0), ends


def _acrobot_slope(env: Any, states: States, torque: States) -> States:
    """Compute the time derivatives of the states (4, K), as `AcrobotEnv._dsdt` does."""
    m1, m2, l1 = env.LINK_MASS_1, env.LINK_MASS_2, env.LINK_LENGTH_1
    lc1, lc2, moment, g = env.LINK_COM_POS_1, env.LINK_COM_POS_2, env.LINK_MOI, 9.8
    theta1, theta2, dtheta1, dtheta2 = states
    cos2, sin2 = np.cos(theta2), np.sin(theta2)
    d1 = m1 * lc1**2 + m2 * (l1**2 + lc2**2 + 2 * l1 * lc2 * cos2) + moment + moment
    d2 = m2 * (lc2**2 + l1 * lc2 * cos2) + moment
    phi2 = m2 * lc2 * g * np.cos(theta1 + theta2 - np.pi / 2.0)
    phi1 = (
        -m2 * l1 * lc2 * _squared(dtheta2) * sin2
        - 2 * m2 * l1 * lc2 * dtheta2 * dtheta1 * sin2
        + (m1 * lc1 + m2 * l1) * g * np.cos(theta1 - np.pi / 2)
        + phi2
    )
    ddtheta2 = (torque + d2 / d1 * phi1 - m2 * l1 * lc2 * _squared(dtheta1) * sin2 - phi2) / (
        m2 * lc2**2 + moment - _squared(d2) / d1
    )
    return np.stack((dtheta1, dtheta2, -(d2 * ddtheta2 + phi1) / d1, ddtheta2))


def _squared(numbers: States) -> States:
    """Square by `pow`, as Gymnasium does: the result may differ from x·x in the last bit."""
    return np.fromiter(map(math.pow, numbers.tolist(), repeat(2.0)), float, len(numbers))


STEPS: dict[str, Step] = {
    "CartPole-v1": cartpole,
    "MountainCar-v0": mountaincar,
    "Acrobot-v1": acrobot,
}
