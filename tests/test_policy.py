from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
import pytest
import torch
from helpers.references import copies_of, random_network

from ril.environments.environment import Environment
from ril.io.errors import UserError
from ril.policy import load_policy, save_policies
from ril.vectorized.architectures import MLP, Dueling, Standardized
from ril.vectorized.latent_networks import ActionRemapping, LatentDynamics, LatentPolicy
from ril.vectorized.networks import Architecture, Network

pytestmark = pytest.mark.quick

ARCHITECTURE = MLP(inputs=4, hidden=(6,), outputs=2)
SEEDS = (3, 8)
RAW = np.random.default_rng(0).normal(size=(50, 4)).astype(np.float32)


@pytest.fixture
def networks() -> dict[str, Network]:
    best = random_network(ARCHITECTURE, 2)
    last = best.copy()
    last.flat.mul_(-1)
    return {"best": best, "last": last}


@pytest.fixture
def saved(tmp_path: Path, cartpole: Environment, networks: dict[str, Network]) -> Path:
    best, last = networks["best"].flat, networks["last"].flat
    save_policies(tmp_path / "policy.pt", cartpole, ARCHITECTURE, SEEDS, best=best, last=last)
    return tmp_path / "policy.pt"


@pytest.mark.parametrize("which", ["best", "last"])
@pytest.mark.parametrize("seed", SEEDS)
def test_a_loaded_policy_is_the_seeds_network_on_scaled_observations(
    saved: Path, cartpole: Environment, networks: dict[str, Network], seed: int, which: str
) -> None:
    module = copies_of(networks[which])[SEEDS.index(seed)]
    expected = module(torch.from_numpy(cartpole.scale(RAW))).detach().numpy()
    found = load_policy(saved, seed, which).values(RAW)
    np.testing.assert_allclose(found, expected, rtol=1e-4, atol=1e-5)


KINDS = [
    dataclasses.replace(ARCHITECTURE, layer_norm=False, negative_slope=None),
    Standardized(dataclasses.replace(ARCHITECTURE, negative_slope=None), 0.5),
    Dueling(dataclasses.replace(ARCHITECTURE, hidden=(5, 3), outputs=1), ARCHITECTURE),
    LatentPolicy(
        LatentDynamics(4, 3, encoder=(5, 6), generator=7, negative_slope=0.1),
        ActionRemapping(4, 3, 2, encoder=(5, 6), hidden=(8, 9), negative_slope=0.3),
    ),
]


@pytest.mark.parametrize("architecture", KINDS)
def test_a_policy_of_any_architecture_is_loaded_as_it_was_saved(
    tmp_path: Path, cartpole: Environment, architecture: Architecture
) -> None:
    network = random_network(architecture, 2)
    path, flat = tmp_path / "policy.pt", network.flat
    save_policies(path, cartpole, architecture, SEEDS, best=flat, last=flat)
    expected = network.infer(np.concatenate([cartpole.scale(RAW)] * 2)).numpy()
    for index, seed in enumerate(SEEDS):
        found = load_policy(path, seed).values(RAW)
        np.testing.assert_allclose(found, expected[index], rtol=1e-4, atol=1e-4)


@pytest.mark.parametrize("architecture", [{"kind": "Oracle"}, {"kind": None}, {}])
def test_a_policy_of_no_known_architecture_is_refused(
    saved: Path, architecture: dict[str, str | None]
) -> None:
    content = torch.load(saved, weights_only=True)
    del content["architecture"]["kind"]
    content["architecture"] |= architecture
    torch.save(content, saved)
    with pytest.raises(UserError, match=r"policy\.pt: not a policy that ril saved"):
        load_policy(saved, 3)


def test_predict_takes_the_best_value(saved: Path) -> None:
    policy = load_policy(saved, 3)
    np.testing.assert_array_equal(policy.predict(RAW), policy.values(RAW).argmax(axis=1))


def test_predict_takes_one_observation_too(saved: Path) -> None:
    policy = load_policy(saved, 3)
    action = policy.predict(RAW[0])
    assert action.shape == ()
    assert action == policy.predict(RAW)[0]


def test_probabilities_are_the_softmax_of_the_values(saved: Path) -> None:
    policy = load_policy(saved, 3)
    powers = np.exp(policy.values(RAW).astype(float))
    expected = powers / powers.sum(axis=1, keepdims=True)
    np.testing.assert_allclose(policy.probabilities(RAW), expected, rtol=1e-5)


def test_a_policy_knows_its_environment(saved: Path) -> None:
    assert load_policy(saved, 3).env_id == "CartPole-v1"


def test_a_file_holds_nothing_but_tensors_and_plain_values(saved: Path) -> None:
    content = torch.load(saved, weights_only=True)
    assert content["seeds"] == list(SEEDS)


@pytest.mark.parametrize(
    ("seed", "which", "says"), [(4, "best", "seed=4: .*3, 8"), (3, "first", "which=first: ")]
)
def test_a_policy_that_the_file_lacks_is_refused(
    saved: Path, seed: int, which: str, says: str
) -> None:
    with pytest.raises(UserError, match=says):
        load_policy(saved, seed, which)


@pytest.mark.parametrize("content", [None, b"", b"not a policy"])
def test_an_unreadable_file_is_refused_by_name(tmp_path: Path, content: bytes | None) -> None:
    path = tmp_path / "policy.pt"
    if content is not None:
        path.write_bytes(content)
    with pytest.raises(UserError, match=r"policy\.pt: not a policy that ril saved"):
        load_policy(path, 0)


def test_another_saved_thing_is_refused_by_name(tmp_path: Path) -> None:
    path = tmp_path / "policy.pt"
    torch.save({"weights": torch.zeros(3)}, path)
    with pytest.raises(UserError, match=r"policy\.pt: not a policy that ril saved"):
        load_policy(path, 0)
