from __future__ import annotations

import io
from typing import Any

import numpy as np
import pytest
import torch

from ril.methods.base import Progress
from ril.run.record import Record

pytestmark = pytest.mark.quick

SEEDS = (3, 8)
ALL = np.array([True, True])


def progress(epoch: int, stopped: tuple[bool, bool] = (False, False)) -> Progress:
    """Seed 3 has used 100 steps an epoch, seed 8 has used 200, and 7 of the expert's."""
    env_samples, expert_samples = epoch * np.array([100, 200]), epoch * np.array([7, 7])
    return Progress(epoch, env_samples, expert_samples, 50, np.array(stopped))


def parameters(epoch: int) -> torch.Tensor:
    return torch.tensor([[10.0 + epoch], [20.0 + epoch]])


@pytest.fixture
def record() -> Record:
    return Record(SEEDS, parameters(0))


def evaluate(record: Record, epoch: int, *aer: float) -> None:
    record.advance(progress(epoch), parameters(epoch))
    record.evaluated(np.array(aer), ALL, {})


def test_last_is_the_latest_policy(record: Record) -> None:
    for epoch in (1, 2):
        record.advance(progress(epoch), parameters(epoch))
    assert torch.equal(record.last, parameters(2))


def test_best_is_the_policy_of_the_best_evaluation(record: Record) -> None:
    evaluate(record, 1, -150.0, -120.0)
    evaluate(record, 2, -110.0, -130.0)
    evaluate(record, 3, -140.0, -125.0)
    assert record.best.flatten().tolist() == [12.0, 21.0]
    assert record.best_epoch.tolist() == [2, 1]
    assert record.best_aer.tolist() == [-110.0, -120.0]


def test_the_first_of_equals_is_best(record: Record) -> None:
    for epoch in (1, 2):
        evaluate(record, epoch, -200.0, -200.0)
    assert record.best_epoch.tolist() == [1, 1]


def test_samples_to_best_are_environments_and_experts_until_then(record: Record) -> None:
    evaluate(record, 1, -150.0, -120.0)
    evaluate(record, 2, -110.0, -130.0)
    assert record.samples_to_best.tolist() == [2 * 100 + 2 * 7, 200 + 7]


def test_the_curve_has_a_point_per_seed_and_evaluation(record: Record) -> None:
    evaluate(record, 1, -150.0, -120.0)
    evaluate(record, 2, -110.0, -130.0)
    found = [(point.seed, point.epoch, point.samples, point.aer) for point in record.curve]
    assert found == [
        (3, 1, 107, -150.0),
        (8, 1, 207, -120.0),
        (3, 2, 214, -110.0),
        (8, 2, 414, -130.0),
    ]


def test_the_curve_keeps_each_seeds_diagnostics(record: Record) -> None:
    record.advance(progress(1), parameters(1))
    record.evaluated(np.zeros(2), ALL, {"epsilon": np.array([0.5, 0.25])})
    assert [point.metrics["epsilon"] for point in record.curve] == [0.5, 0.25]


def test_an_evaluation_counts_for_its_seeds_only(record: Record) -> None:
    record.advance(progress(1), parameters(1))
    record.evaluated(np.array([5.0, 6.0]), np.array([False, True]), {})
    assert [point.seed for point in record.curve] == [8]
    assert record.best_aer.tolist() == [-np.inf, 6.0]
    assert record.best.flatten().tolist() == [10.0, 21.0]


def test_advance_names_the_seeds_that_have_just_stopped(record: Record) -> None:
    assert record.advance(progress(1, (False, True)), parameters(1)).tolist() == [False, True]
    assert record.advance(progress(2, (False, True)), parameters(2)).tolist() == [False, False]
    assert record.advance(progress(3, (True, True)), parameters(3)).tolist() == [True, False]


@pytest.mark.parametrize("name", ["last", "epochs", "env_samples", "expert_samples"])
def test_a_stopped_seed_no_longer_changes(record: Record, name: str) -> None:
    def values() -> Any:
        return getattr(record, name).tolist()

    record.advance(progress(1, (False, True)), parameters(1))
    after_first = values()
    record.advance(progress(2, (False, True)), parameters(2))
    assert values()[1] == after_first[1]
    assert values()[0] != after_first[0]


def test_samples_before_training_are_kept(record: Record) -> None:
    record.advance(progress(1), parameters(1))
    assert record.pre_samples == 50


def test_the_epoch_of_the_stop_still_counts(record: Record) -> None:
    record.advance(progress(1, (False, True)), parameters(1))
    assert record.epochs.tolist() == [1, 1]


def test_a_restored_record_continues_alike(record: Record) -> None:
    record.advance(progress(1), parameters(1))
    record.evaluated(np.array([-150.0, -120.0]), ALL, {"epsilon": np.array([0.5, 0.25])})
    record.advance(progress(2, (False, True)), parameters(2))
    buffer = io.BytesIO()
    torch.save(record.state_dict(), buffer)
    buffer.seek(0)
    resumed = Record(SEEDS, parameters(9))
    resumed.load_state_dict(torch.load(buffer, weights_only=True))
    for each in (record, resumed):
        each.advance(progress(3, (False, True)), parameters(3))
        each.evaluated(np.array([-100.0, -100.0]), np.array([True, False]), {})
    assert resumed.curve == record.curve
    assert repr(resumed.state_dict()) == repr(record.state_dict())


def test_an_evaluation_that_may_not_be_best_is_of_the_curve_only(record: Record) -> None:
    record.advance(progress(1), parameters(1))
    record.evaluated(np.array([-90.0, -90.0]), ALL, {}, may_be_best=False)
    record.advance(progress(2), parameters(2))
    record.evaluated(np.array([-150.0, -120.0]), ALL, {})
    assert [point.aer for point in record.curve] == [-90.0, -90.0, -150.0, -120.0]
    assert record.best_epoch.tolist() == [2, 2]
    assert record.best_aer.tolist() == [-150.0, -120.0]
