"""The examples of docs/demonstrations.md do what they say."""

from __future__ import annotations

import re
import warnings
from pathlib import Path

import numpy as np
import pytest
from helpers.runs import follow_rule

from ril.demonstrations.files import load_demonstrations
from ril.environments.environment import Environment

PAGE = Path(__file__).parents[2] / "docs" / "demonstrations.md"
IL_DATASETS, MINARI = re.findall(r"```python\n(.*?)```", PAGE.read_text("utf-8"), re.DOTALL)


def test_the_il_datasets_example_is_read(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, mountaincar: Environment
) -> None:
    monkeypatch.chdir(tmp_path)
    exec(IL_DATASETS, {})
    found = load_demonstrations(tmp_path / "mine.npz", mountaincar)
    played = follow_rule(mountaincar, seeds=(0, 1, 2))
    np.testing.assert_array_equal(
        found.observations, np.concatenate([each.observations[:-1] for each in played])
    )
    assert found.returns.tolist() == [each.total_reward for each in played]


def test_the_minari_example_is_read(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, mountaincar: Environment
) -> None:
    pytest.importorskip("minari")
    pytest.importorskip("h5py")
    pytest.importorskip("PIL")
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # minari warns of missing metadata
        exec(MINARI, {})
    found = load_demonstrations(tmp_path / "car" / "expert-v0", mountaincar)
    played = follow_rule(mountaincar, seeds=(0, 1, 2))
    np.testing.assert_array_equal(
        found.observations, np.concatenate([each.observations for each in played])
    )
    assert found.returns.tolist() == [each.total_reward for each in played]
