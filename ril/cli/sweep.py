"""Expand a sweep into cells, and check each of them before any is run."""

from __future__ import annotations

import itertools
import shlex
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, cast

from hydra.core.hydra_config import HydraConfig
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.override_parser.types import Override, Quote, QuotedString
from omegaconf import DictConfig, OmegaConf, open_dict

from ril.cli.command import MISTAKES, SWEEP_GROUPS, cell_command, in_one_line
from ril.cli.configuration import from_hydra
from ril.cli.variant import refuse_shadowed
from ril.config.schema import Config
from ril.demonstrations.files import demonstrations_path, load_demonstrations
from ril.environments.environment import load_environment
from ril.io.errors import UserError
from ril.run.earlier import has_rows
from ril.run.identity import run_folder


@dataclass
class Cell:
    """A cell of a sweep.

    Attributes:
        overrides: `key=value` on its command line.
        command: the command that runs it alone.
        config: configuration of its run; None if the overrides were refused.
        folder: folder of its run; with resume=false, further runs are in `<folder>-2`, ….
        mistake: why the cell was refused or failed; None if neither happened.
        before: number of earlier finished runs, which do not count with resume=false.
    """

    overrides: list[str]
    command: str
    config: Config | None = None
    folder: Path = field(default_factory=Path)
    mistake: str | None = None
    before: int = 0

    @property
    def runs(self) -> list[Path]:
        """Return the `results.csv` of each finished run of the cell."""
        parent, name = self.folder.parent, self.folder.name
        return [path for each in (name, f"{name}-*") for path in parent.glob(f"{each}/results.csv")]

    @property
    def is_done(self) -> bool:
        """Return whether a finished run counts for this sweep."""
        return self.config is not None and len(self.runs) > self.before


def expand(
    sweeps: Sequence[Mapping[str, str]] | None, arguments: Sequence[str], parser: OverridesParser
) -> list[list[str]]:
    """Return the overrides of each cell of several sweeps.

    Args:
        sweeps: comma-separated values by key, for each sweep; None for one sweep without keys.
        arguments: overrides of the command line. Of a key that a sweep has too, only the values
            that both have remain; a sweep with no value left is skipped.
        parser: Hydra's parser of overrides.

    Returns:
        `key=value` for every combination of values; the last key's values vary fastest.

    Raises:
        UserError: every sweep is skipped.
    """
    given = {each.get_key_element(): each for each in parser.parse_overrides(list(arguments))}
    jobs: list[list[str]] = []
    skipped: list[str] = []
    for sweep in sweeps or [{}]:
        own = parser.parse_overrides([f"{key}={values}" for key, values in sweep.items()])
        choices = {each.get_key_element(): list(_values(each)) for each in given.values()}
        for each in own:
            key = each.get_key_element()
            choices.pop(key, None)
            choices[key] = _narrowed(each, given.get(key))
            if not choices[key]:
                skipped.append(str(each.input_line))
        texts = [[f"{key}={value}" for value in values] for key, values in choices.items()]
        jobs += [list(job) for job in itertools.product(*texts)]
    if not jobs:
        key = skipped[0].partition("=")[0]
        raise UserError(f"{given[key].input_line}: the sweep has only {', '.join(skipped)}")
    return jobs


def _narrowed(own: Override, given: Override | None) -> list[str]:
    """Return the values of a sweep's key that the command line has too; all if it lacks the key."""
    values = _values(own)
    allowed = values if given is None else _values(given)
    return [text for text, value in values.items() if value in allowed.values()]


def _values(override: Override) -> dict[str, object]:
    """Return the values of an override by their text."""
    if override.is_sweep_override():
        return dict(zip(override.sweep_string_iterator(), override.sweep_iterator(), strict=True))
    return {override.get_value_element_as_str(): override.value()}


@contextmanager
def _as_hydra(composed: DictConfig, number: int) -> Iterator[None]:
    """Let `${hydra:…}` in a configuration be resolved in the block, as in the cell of a number."""
    before = HydraConfig.instance().cfg
    for key in ("num", "id"):
        OmegaConf.update(composed, f"hydra.job.{key}", number, force_add=True)
    HydraConfig.instance().cfg = cast(Any, OmegaConf.masked_copy(composed, "hydra"))
    with open_dict(composed):
        del composed["hydra"]
    try:
        yield
    finally:
        HydraConfig.instance().cfg = before


def _fixed(overrides: list[str], composed: DictConfig) -> list[str]:
    """Return overrides with their present values for interpolations, such as `${now:%H-%M}`.

    In the cell they could have other values, and its rows would be where nobody looks for them.
    """
    fixed, given = [], set()
    for override in overrides:
        name = override.partition("=")[0]
        key = name.lstrip("+")
        given.add(key)
        value = OmegaConf.select(composed, key) if "$" in override else None
        fixed.append(override if value is None else _override(name, value))
    for key in ("output_dir", "demonstrations"):  # of a file of the user's own
        if key not in given and OmegaConf.is_interpolation(composed, key):
            fixed.append(_override(key, composed[key]))
    return fixed


def _override(key: str, value: Any) -> str:
    """Return `key=value` in Hydra's grammar."""
    if isinstance(value, str):
        quoted = QuotedString(text=value, quote=Quote.double)
        return f"{key}={quoted.with_quotes()}"
    plain: Any = value
    if OmegaConf.is_config(value):
        plain = OmegaConf.to_container(value, resolve=True)
    return f"{key}={Override._get_value_element_as_str(plain)}"


def plan(
    jobs: Sequence[list[str]], compose: Callable[[list[str]], DictConfig], config: DictConfig
) -> list[Cell]:
    """Return the cells of a sweep; overrides that give the same run are one cell.

    Args:
        jobs: overrides of each cell.
        compose: composes a configuration from overrides.
        config: Hydra's configuration of the sweep as a whole.

    Returns:
        All cells; `mistake` says why a cell was refused.

    Raises:
        UserError: all cells were refused.
    """
    cells: dict[object, Cell] = {}
    refuse_shadowed(config.hydra.runtime.config_sources)
    for number, overrides in enumerate(jobs):
        command = shlex.join(cell_command(overrides, config.hydra.runtime.config_sources))
        try:
            composed = compose(overrides)
            if composed.hydra.sweeper != config.hydra.sweeper:
                groups = [each for each in overrides if each.startswith(SWEEP_GROUPS)]
                raise UserError(f"{' '.join(groups)}: several sweeps; give one at a time")
            with _as_hydra(composed, number):
                run, overrides = from_hydra(composed), _fixed(overrides, composed)
            command = shlex.join(cell_command(overrides, config.hydra.runtime.config_sources))
            expert = load_demonstrations(demonstrations_path(run), load_environment(run.env))
            cell = Cell(overrides, command, run, run_folder(run, expert.sha256))
            if run.resume:
                has_rows(cell.folder, run)  # raises if results.csv is damaged or another run's
            else:
                cell.before = len(cell.runs)
            cells.setdefault(cell.folder, cell)
        except MISTAKES as error:
            cells[len(cells)] = Cell(overrides, command, mistake=in_one_line(error))
    if all(cell.mistake for cell in cells.values()):
        raise UserError("; ".join(dict.fromkeys(str(cell.mistake) for cell in cells.values())))
    return list(cells.values())
