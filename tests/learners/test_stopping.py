from __future__ import annotations

import io
from collections.abc import Sequence

import numpy as np
import torch

from ril.learners.stopping import StoppingConfig, StoppingRule

#: One epoch of one seed: the actions at the expert's states, and the cloning loss.
Epoch = tuple[list[int], float]
A, B, C = [0, 0, 0], [0, 0, 1], [0, 1, 1]


def rule(patience: int | None, tolerance: float = 0.1, seeds: int = 1) -> StoppingRule:
    return StoppingRule(StoppingConfig(patience=patience, loss_tolerance=tolerance), seeds)


def stopped_after(stopping: StoppingRule, epochs: Sequence[Epoch]) -> int | None:
    """The epoch, from 1, after which the only seed is stopped."""
    for number, (actions, loss) in enumerate(epochs, start=1):
        stopping.update(np.array([actions]), np.array([loss]))
        if stopping.stopped[0]:
            return number
    return None


def test_falling_losses_and_new_actions_do_not_stop() -> None:
    assert stopped_after(rule(1), [(A, 1.0), (B, 0.8), (C, 0.6), (A, 0.4)]) is None


def test_the_first_epoch_never_stops() -> None:
    assert stopped_after(rule(1), [(A, 9.0)]) is None


def test_equal_actions_stop_though_the_loss_falls() -> None:
    assert stopped_after(rule(1), [(A, 1.0), (B, 0.5), (B, 0.2)]) == 3


def test_a_loss_that_does_not_fall_stops_though_actions_change() -> None:
    assert stopped_after(rule(1), [(A, 1.0), (B, 0.5), (C, 0.5)]) == 3


def test_a_fall_within_the_tolerance_is_none() -> None:
    assert stopped_after(rule(1, 0.1), [(A, 1.0), (B, 0.91)]) == 2


def test_a_fall_beyond_the_tolerance_is_one() -> None:
    assert stopped_after(rule(1, 0.1), [(A, 1.0), (B, 0.89)]) is None


def test_patience_counts_epochs_in_a_row() -> None:
    still = (A, 1.0)
    assert stopped_after(rule(3), [still] * 9) == 4


def test_a_change_starts_the_count_again() -> None:
    epochs = [(A, 1.0), (A, 1.0), (A, 1.0), (B, 0.5), (B, 0.5), (B, 0.5), (B, 0.5)]
    assert stopped_after(rule(3), epochs) == 7


def test_without_patience_nothing_stops() -> None:
    assert stopped_after(rule(None), [(A, 1.0)] * 50) is None


def test_a_stopped_seed_stays_stopped() -> None:
    stopping = rule(1)
    stopped_after(stopping, [(A, 1.0), (A, 1.0)])
    stopping.update(np.array([B]), np.array([0.1]))
    assert stopping.stopped.tolist() == [True]


def test_each_seed_stops_by_itself() -> None:
    stopping = rule(1, seeds=3)
    stopping.update(np.array([A, A, A]), np.array([1.0, 1.0, 1.0]))
    stopping.update(np.array([A, B, B]), np.array([0.5, 0.5, 1.0]))
    assert stopping.stopped.tolist() == [True, False, True]


def test_a_loaded_state_resumes_bit_identically() -> None:
    stopping = rule(3)
    assert stopped_after(stopping, [(A, 1.0), (A, 1.0), (A, 1.0)]) is None
    buffer = io.BytesIO()
    torch.save(stopping.state_dict(), buffer)
    buffer.seek(0)
    resumed = rule(3)
    resumed.load_state_dict(torch.load(buffer, weights_only=True))
    assert stopped_after(resumed, [(A, 0.5)]) == 1
