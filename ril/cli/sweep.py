"""Which cells a sweep has."""

from __future__ import annotations

import shlex
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.override_parser.types import Override
from omegaconf import DictConfig, open_dict

from ril.cli.command import MISTAKES, SWEEP_GROUPS, cell_command, in_one_line
from ril.config.checks import from_hydra, run_folder
from ril.config.schema import Config
from ril.demonstrations.files import demonstrations_path, load_demonstrations
from ril.environments import load_environment
from ril.io.errors import UserError
from ril.run.experiment import has_rows


@dataclass
class Cell:
    """A cell of a sweep.

    Attributes:
        overrides: that make it, without those of the sweep's other cells.
        command: that runs it alone.
        config: of its run.
        folder: of its run, or of the first one where it is run anew.
        mistake: why it has none, or why it failed.
        before: how many runs it had when the sweep began that do not count as its own.
    """

    overrides: list[str]
    command: str
    config: Config | None = None
    folder: Path = field(default_factory=Path)
    mistake: str | None = None
    before: int = 0

    @property
    def runs(self) -> list[Path]:
        """The rows of all its runs; those of a run anew lie in `<run_id>-2` and so on."""
        parent, name = self.folder.parent, self.folder.name
        return [path for each in (name, f"{name}-*") for path in parent.glob(f"{each}/results.csv")]

    @property
    def is_done(self) -> bool:
        """Whether it has rows that count."""
        return self.config is not None and len(self.runs) > self.before


def expand(
    sweeps: Sequence[Mapping[str, str]] | None, arguments: Sequence[str], parser: OverridesParser
) -> list[list[Override]]:
    """What each of several sweeps runs through, as Hydra's overrides.

    Args:
        sweeps: values by key, separated by commas; None is one sweep without keys of its own.
        arguments: the command line; where it gives a key of a sweep, only the values that both
            have are left, and a sweep without any is left out.
        parser: Hydra's.

    Raises:
        UserError: nothing is left.
    """
    given = {each.get_key_element(): each for each in parser.parse_overrides(list(arguments))}
    expanded, left_out = [], []
    for sweep in sweeps or [{}]:
        own = parser.parse_overrides([f"{key}={values}" for key, values in sweep.items()])
        narrowed = [_narrowed(each, given.get(each.get_key_element())) for each in own]
        left_out += [
            f"{a.input_line}" for a, values in zip(own, narrowed, strict=True) if not values
        ]
        if all(narrowed):
            keys = [each.get_key_element() for each in own]
            texts = [f"{key}={','.join(v)}" for key, v in zip(keys, narrowed, strict=True)]
            others = [each for key, each in given.items() if key not in keys]
            expanded.append([*others, *parser.parse_overrides(texts)])
    if not expanded:
        key = left_out[0].partition("=")[0]
        raise UserError(f"{given[key].input_line}: the sweep has only {', '.join(left_out)}")
    return expanded


def _narrowed(own: Override, given: Override | None) -> list[str]:
    """The values of a sweep's key, of those that the command line gives, if it does."""
    values = _values(own)
    wanted = values if given is None else _values(given)
    return [text for text, value in values.items() if value in wanted.values()]


def _values(override: Override) -> dict[str, object]:
    """What a key is given, by how it is written."""
    if override.is_sweep_override():
        return dict(zip(override.sweep_string_iterator(), override.sweep_iterator(), strict=True))
    return {override.get_value_element_as_str(): override.value()}


def plan(
    jobs: Sequence[list[str]], compose: Callable[[list[str]], DictConfig], config: DictConfig
) -> list[Cell]:
    """The cells of a sweep, each once however often it is asked for.

    Args:
        jobs: overrides of each.
        compose: what Hydra makes of them.
        config: what it makes of the sweep as a whole.

    Raises:
        UserError: none of them can be run.
    """
    cells: dict[object, Cell] = {}
    for overrides in jobs:
        command = shlex.join(cell_command(overrides, config.hydra.runtime.config_sources))
        try:
            composed = compose(overrides)
            if composed.hydra.sweeper != config.hydra.sweeper:
                groups = [each for each in overrides if each.startswith(SWEEP_GROUPS)]
                raise UserError(f"{' '.join(groups)}: a sweep of its own; give one at a time")
            with open_dict(composed):
                del composed["hydra"]
            run = from_hydra(composed)
            expert = load_demonstrations(demonstrations_path(run), load_environment(run.env))
            cell = Cell(overrides, command, run, run_folder(run, expert.sha256))
            if run.resume:
                has_rows(cell.folder, run, cell.folder.name)  # or refuses what lies there
            else:
                cell.before = len(cell.runs)
            cells.setdefault(cell.folder, cell)
        except MISTAKES as error:
            cells[len(cells)] = Cell(overrides, command, mistake=in_one_line(error))
    if all(cell.mistake for cell in cells.values()):
        raise UserError("; ".join(dict.fromkeys(str(cell.mistake) for cell in cells.values())))
    return list(cells.values())
