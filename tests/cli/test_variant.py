"""Which runs are of the paper's cells, and what sets the others apart."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import hydra
import pandas as pd
import pytest
from helpers.runs import Ended, composed
from hydra.core.global_hydra import GlobalHydra

from ril.cli.configuration import from_file, from_hydra
from ril.cli.variant import own_folders, refuse_shadowed, variant
from ril.config.schema import Config
from ril.demonstrations.files import shipped_path
from ril.io.errors import UserError, printable
from ril.io.paths import config_folder
from ril.io.rows import load_results
from ril.report.beside import paper_cell
from ril.run.identity import run_id

Here = Callable[..., Ended]
REFERENCE = Path(__file__).parents[2] / "outputs" / "reference"
MOUNTAINCAR = shipped_path("mountaincar")
#: env=gym with every value of env=mountaincar.
ALIKE = (
    *("env=gym", "env.id=MountainCar-v0", "env.name=mountaincar"),
    *("env.solved_return=-110", "env.goal.terminated=true"),
)


def apart(*overrides: str, choice: str = "") -> str:
    """What sets a command line's run apart."""
    given = [each.removeprefix("env=") for each in overrides if each.startswith("env=")]
    config = from_hydra(composed(*overrides))
    return variant(config, choice or [*given, "mountaincar"][0], [])


@pytest.mark.parametrize(
    ("overrides", "said"),
    [
        ((), ""),
        (("method=bc", "method.epochs=3", "seeds=[7]", "env.vectorized=false"), ""),
        (("ablation.k=3", "ablation.trajectories=25"), ""),
        (("exact=false", "compile=true", "output_dir=x", "resume=false"), ""),
        (ALIKE, ""),
        (("env.id=other:EasyCar-v0",), "env.id=other:EasyCar-v0"),
        (
            ("env=gym", "env.id=other:EasyCar-v0", "env.name=mountaincar", "method=bc"),
            "env.id=other:EasyCar-v0 env.solved_return=None env.goal.terminated=None",
        ),
        ((*ALIKE, "env.id=gymnasium:MountainCar-v0"), "env.id=gymnasium:MountainCar-v0"),
        (("+env.kwargs.gravity=9",), "env.kwargs.gravity=9"),
        (("+env.kwargs.options={}",), "env.kwargs.options={}"),
        (("+env.kwargs.options=[]",), "env.kwargs.options=[]"),
        (("+env.kwargs.mode='1'",), "env.kwargs.mode='1'"),
        (("+env.kwargs.mode=1",), "env.kwargs.mode=1"),
        (("+env.kwargs.max_episode_steps=50",), "env.kwargs.max_episode_steps=50"),
        (("env.goal.terminated=false",), "env.goal.terminated=False"),
        (("env.goal.minimum_return=-150",), "env.goal.minimum_return=-150.0"),
        (("env.solved_return=0",), "env.solved_return=0.0"),
        (("env.observation_low=[-1,-1]",), "env.observation_low=[-1.0, -1.0]"),
        (("env.scale_observations=false",), "env.scale_observations=False"),
        (("evaluation.episodes=3",), "evaluation.episodes=3"),
        (("env=cartpole", "env.name=mountaincar"), "env.id=CartPole-v1"),
        (("env=gym", "env.id=MountainCar-v0"), ""),
        (("env=gym", "env.id=other:A-v0", "env.name=mine"), "env.id=other:A-v0"),
    ],
)
def test_a_run_says_what_sets_it_apart(overrides: tuple[str, ...], said: str) -> None:
    found = apart(*overrides)
    assert found == said or (said and found.startswith(f"{said} "))


def test_what_the_users_files_say_of_a_shipped_name_is_no_default(tmp_path: Path) -> None:
    # As of a file env/easy.yaml that begins with `name: mountaincar`.
    own = composed("env=gym", "env.id=Easy-v0", "env.name=mountaincar").copy()
    (tmp_path / "env").mkdir()
    (tmp_path / "env" / "easy.yaml").write_text("name: mountaincar\nid: Easy-v0\n")
    found = variant(from_hydra(own), "easy", [str(tmp_path)])
    assert found.startswith("env.id=Easy-v0 ")


@pytest.mark.parametrize("name", ["mine", "a,b=(c) [d]", "it's", "größe"])
def test_an_environment_of_the_users_own_has_the_defaults_of_its_file(
    tmp_path: Path, name: str
) -> None:
    folder = tmp_path / name
    (folder / "env").mkdir(parents=True)
    (folder / "env" / "short.yaml").write_text(
        "name: short\nid: CartPole-v1\nkwargs: {max_episode_steps: 20}\n"
    )
    given = ("env=gym", "env.id=CartPole-v1", "env.name=short")
    with_all = from_hydra(composed(*given, "+env.kwargs.max_episode_steps=20"))
    assert variant(with_all, "short", [str(folder)]) == ""
    without = from_hydra(composed(*given))
    assert variant(without, "short", [str(folder)]) == "~env.kwargs.max_episode_steps"


def test_demonstrations_are_named_by_their_content(tmp_path: Path) -> None:
    for folder, name in (("a", "cartpole"), ("b", "acrobot")):
        (tmp_path / folder).mkdir()
        shutil.copy(shipped_path(name), tmp_path / folder / "mine.npz")
    found = {apart(f"demonstrations={tmp_path / each}/mine.npz") for each in ("a", "b")}
    assert len(found) == 2
    assert all(each.startswith("demonstrations=mine.npz@") for each in found)


def test_a_copy_of_the_shipped_demonstrations_is_what_they_are(tmp_path: Path) -> None:
    copy = Path(shutil.copy(MOUNTAINCAR, tmp_path / "copy.npz"))
    assert apart(f"demonstrations={copy}") == ""
    # They belong to their own id, and so say that they are another's.
    other = apart("env.id=other:EasyCar-v0", f"demonstrations={copy}")
    assert other.startswith("env.id=other:EasyCar-v0 demonstrations=copy.npz@")
    with_level = apart("ablation.expert_return=-140", f"demonstrations={copy}")
    assert with_level.startswith("demonstrations=copy.npz@")


def test_demonstrations_that_are_missing_are_named() -> None:
    with pytest.raises(UserError, match=r"^demonstrations=none\.npz: no such file or folder$"):
        apart("demonstrations=none.npz")


@pytest.mark.skipif(not REFERENCE.exists(), reason="outputs/reference comes with a clone only")
@pytest.mark.parametrize("env", ["cartpole", "acrobot", "mountaincar", "lunarlander"])
def test_the_kept_rows_are_set_apart_as_they_say(env: str) -> None:
    rows, _ = load_results([REFERENCE / env])
    runs = rows.drop_duplicates("run_id")
    variants = runs[runs["variant"] != ""].drop_duplicates("variant")
    default = runs[runs["method"].isin(["random", "bc", "iupe"])].drop_duplicates("method")
    chosen = pd.concat([variants[::3], default])
    assert len(chosen) > 2
    for folder, said in zip(chosen["folder"], chosen["variant"], strict=True):
        config = from_file(folder / "config.yaml")
        assert variant(config, env, []) == said


def test_defaults_are_rils_own_in_a_command_with_other_files(tmp_path: Path) -> None:
    # As of ril-run --config-path with a changed copy of ril's files.
    copy = Path(shutil.copytree(config_folder(), tmp_path / "conf"))
    changed = copy / "method" / "random.yaml"
    changed.write_text(changed.read_text() + "\nevaluation:\n  episodes: 7\n")
    with hydra.initialize_config_dir(str(copy), version_base="1.3"):
        given = hydra.compose("config", ["method=random"])
        running = GlobalHydra.instance().hydra
        assert variant(from_hydra(given), "mountaincar", [str(copy)]) == "evaluation.episodes=7"
        assert GlobalHydra.instance().hydra is running


def sources(*folders: tuple[str, Path]) -> list[Any]:
    return [
        SimpleNamespace(schema="file", provider=provider, path=str(folder))
        for provider, folder in folders
    ]


def test_a_file_that_would_be_ignored_is_refused(tmp_path: Path) -> None:
    shipped = config_folder()
    given = sources(("main", shipped), ("command-line", tmp_path))
    (tmp_path / "env").mkdir()
    own = tmp_path / "env" / "mountaincar.yaml"
    shutil.copy(shipped / "env" / "mountaincar.yaml", own)
    refuse_shadowed(given)  # the same content
    own.write_text("name: mountaincar\nid: Other-v0\n")
    with pytest.raises(UserError, match=r"mountaincar\.yaml: would be ignored for "):
        refuse_shadowed(given)
    assert own_folders(given) == [str(tmp_path)]


EASY = """
import gymnasium as gym
gym.register(
    "EasyCar-v0",
    entry_point="gymnasium.envs.classic_control:MountainCarEnv",
    max_episode_steps=200,
)
"""


@pytest.mark.parametrize(
    "command",
    [
        ("env=gym", "env.id=easy_car:EasyCar-v0", "env.name=mountaincar"),
        ("env=mountaincar", "env.id=easy_car:EasyCar-v0"),
        ("env=mountaincar", "+env.kwargs.goal_velocity=0.01"),
        ("env=mountaincar", "env.goal.minimum_return=-150"),
    ],
)
def test_no_run_enters_a_table_as_what_it_is_not(
    here: Here, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, command: tuple[str, ...]
) -> None:
    (tmp_path / "easy_car.py").write_text(EASY)
    monkeypatch.syspath_prepend(tmp_path)
    shutil.copy(MOUNTAINCAR, tmp_path / "mine.npz")
    given = (*command, "demonstrations=mine.npz", "method=random", "seeds=1")
    ended = here(*given)
    assert (ended.status, ended.errors) == (0, "")
    assert "the paper reports" not in ended.output
    rows, left_out = load_results([tmp_path])
    assert (len(rows), left_out) == (1, [])
    assert rows["env"].tolist() == ["mountaincar"]
    assert paper_cell(rows) is None


def test_the_same_run_id_is_the_same_variant(tmp_path: Path) -> None:
    copy = Path(shutil.copy(MOUNTAINCAR, tmp_path / "copy.npz"))
    commands = [(), ALIKE, (f"demonstrations={copy}",), ("env.vectorized=false",)]
    configs: list[Config] = [from_hydra(composed(*each)) for each in commands]
    assert len({run_id(config, "0") for config in configs}) == 1
    assert {apart(*each) for each in commands} == {""}


@pytest.mark.parametrize("text", ["a\nb", "a\tb", "a\x1fb", "a\u2028b", "a\udcffb", "x" * 20_000])
def test_a_text_of_a_row_is_one_short_line(text: str) -> None:
    found = printable(text)
    assert found.isprintable()
    assert len(found) <= 1000
    assert found != printable(text + "!")


def test_printable_text_stays_as_it_is() -> None:
    assert printable("a=[1, 2] ü=“…”") == "a=[1, 2] ü=“…”"
