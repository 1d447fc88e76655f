"""What several tests share: configurations, environments and small sets of expert trajectories."""

from __future__ import annotations

import ril  # noqa: F401 - first, because it fixes the kernels of NumPy and torch

# isort: split

import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch
from helpers.runs import (
    CARTPOLE,
    QUICK_RUN,
    RULES,
    Ended,
    Silence,
    composed,
    follow_rule,
    quick_method,
)
from hydra.core.global_hydra import GlobalHydra
from hypothesis import settings

from ril.cli.configuration import from_hydra
from ril.cli.run import main
from ril.config.schema import Config
from ril.environments.environment import Environment, load_environment
from ril.experts.collection import save
from ril.methods.base import Method
from ril.methods.registry import spec
from ril.run.prepare import prepare
from ril.task import Task

torch.set_num_threads(1)
settings.register_profile("ril", deadline=None, derandomize=True, max_examples=50)
settings.register_profile("quick", settings.get_profile("ril"), max_examples=5)


def pytest_configure(config: pytest.Config) -> None:
    """Draw fewer examples in `make quick`."""
    settings.load_profile("quick" if config.getoption("markexpr") == "quick" else "ril")


Compose = Callable[..., Config]


@pytest.fixture(scope="session")
def compose() -> Compose:
    """The checked configuration of a command line, a new one at each call."""
    return lambda *overrides: from_hydra(composed(*overrides))


@pytest.fixture(scope="session")
def environments(compose: Compose) -> dict[str, Environment]:
    """The paper's four environments, by name."""
    names = ("cartpole", "acrobot", "mountaincar", "lunarlander")
    return {name: load_environment(compose(f"env={name}").env) for name in names}


@pytest.fixture(scope="session")
def mountaincar(environments: dict[str, Environment]) -> Environment:
    return environments["mountaincar"]


@pytest.fixture(scope="session")
def cartpole(environments: dict[str, Environment]) -> Environment:
    return environments["cartpole"]


@pytest.fixture(scope="session")
def demonstration_files(
    environments: dict[str, Environment], tmp_path_factory: pytest.TempPathFactory
) -> dict[str, Path]:
    """Three trajectories of a rule, by environment."""
    folder = tmp_path_factory.mktemp("demonstrations")
    files = {name: folder / f"{name}.npz" for name in RULES}
    for name, file in files.items():
        save(file, follow_rule(environments[name], seeds=(0, 1, 2)))
    return files


@pytest.fixture(scope="session")
def quick(compose: Compose, demonstration_files: dict[str, Path]) -> Compose:
    """The configuration of a small run of RIL on CartPole, or as the overrides say."""

    def quickly(*overrides: str) -> Config:
        named = [each.removeprefix("method=") for each in overrides if each.startswith("method=")]
        settings = quick_method(named[-1] if named else "ril")
        config = compose(*QUICK_RUN, *settings, *CARTPOLE, *overrides)
        if config.demonstrations is None:
            config.demonstrations = str(demonstration_files[config.env.name])
        return config

    return quickly


@pytest.fixture(scope="session")
def make_task() -> Callable[[Config], Task]:
    """What a method is given, for a configuration that names its demonstrations."""

    def made(config: Config) -> Task:
        return prepare(config).task()

    return made


@pytest.fixture(scope="session")
def make_method(quick: Compose, make_task: Callable[[Config], Task]) -> Callable[..., Method]:
    """A new method on the small run's configuration, with overrides."""

    def made(name: str, *overrides: str) -> Method:
        config = quick(f"method={name}", *overrides)
        build = spec(name).build
        assert build is not None
        return build(config.method, make_task(config))

    return made


@pytest.fixture
def silence() -> Silence:
    return Silence()


@pytest.fixture
def here(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> Callable[..., Ended]:
    """Run `ril-run` in this process, which is faster than a process of its own."""

    def ran(*arguments: str) -> Ended:
        monkeypatch.chdir(tmp_path)
        monkeypatch.setattr(sys, "argv", ["ril-run", *arguments])
        monkeypatch.setenv("HYDRA_FULL_ERROR", "0")  # the command sets it; put back after
        GlobalHydra.instance().clear()
        try:
            main()
            status: Any = 0
        except SystemExit as end:
            status = end.code
        captured = capfd.readouterr()
        if isinstance(status, str):  # the interpreter prints it on stderr, and ends with 1
            return Ended(1, captured.out, f"{captured.err}{status}\n")
        return Ended(status, captured.out, captured.err)

    return ran
