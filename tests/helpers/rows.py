"""A row as a run writes it."""

from __future__ import annotations

import dataclasses

from ril.io.rows import Row

ROW = Row(
    run_id="0123456789",
    env="mountaincar",
    method="ril",
    variant="method.q_learning.loss=mse",
    seed=0,
    k=2.0,
    n=150.0,
    trajectories=1,
    expert_return=None,
    epochs=150,
    total_timesteps=2_000_000,
    best_epoch=95,
    aer=-105.25,
    aer_std=6.5,
    aer_last=-110.0,
    performance=1.25,
    env_samples=16000,
    expert_samples=15900,
    pre_samples=15000,
    samples_to_best=20000,
    random_return=-200.0,
    expert_return_measured=-106.0,
    wall_seconds=61.5,
    commit="12345e678901",
    digits="exact",
)


def row(**changes: object) -> Row:
    """The row with other values."""
    return dataclasses.replace(ROW, **changes)
