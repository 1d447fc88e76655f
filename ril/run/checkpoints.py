"""Save and load checkpoints; a run resumes only from an intact one of the same run and code."""

from __future__ import annotations

import hashlib
import io
from pathlib import Path
from typing import Any

import torch

from ril.io.errors import UserError, one_line
from ril.io.files import tensor_bytes, write_atomically

#: First line of the file; its number rises with each version that cannot resume earlier files.
_HEAD = b"ril checkpoint 2\n"
_DIGEST = hashlib.sha256().digest_size
_AGAIN = "delete it, or give resume=false, to start again"


def save_checkpoint(path: Path, origin: dict[str, str], state: dict[str, Any]) -> None:
    """Write everything that the rest of a run depends on.

    Args:
        path: the file to write.
        origin: what must be the same when the run resumes; see `ril.run.provenance.origin`.
        state: tensors and plain values.

    Raises:
        WriteError: the file cannot be written; the previous checkpoint is kept.
    """
    content = tensor_bytes({"origin": origin, "state": state})
    # torch.load verifies no checksums, so a damaged number would go unnoticed.
    write_atomically(path, _HEAD, hashlib.sha256(content).digest(), content)


def load_checkpoint(path: Path, origin: dict[str, str]) -> dict[str, Any]:
    """Read a checkpoint of the same run and code; no code in the file is executed.

    Args:
        path: the file to read.
        origin: this run's, with which the checkpoint's must agree.

    Returns:
        The state that was saved.

    Raises:
        UserError: the checkpoint is damaged, or belongs to another run or other code.
    """
    try:
        data = path.read_bytes()
        if not data.startswith(_HEAD):
            known = data.startswith(_HEAD[: _HEAD.rindex(b" ")])
            raise ValueError(
                "written by another version of ril" if known else "not a checkpoint of ril"
            )
        content = memoryview(data)[len(_HEAD) + _DIGEST :]
        if hashlib.sha256(content).digest() != data[len(_HEAD) : len(_HEAD) + _DIGEST]:
            raise ValueError("damaged")
        saved: dict[str, Any] = torch.load(io.BytesIO(content), weights_only=True)
        before: dict[str, str] = saved["origin"]
        state: dict[str, Any] = saved["state"]
        changed = [key for key in origin if before.get(key) != origin[key]]
    except Exception as error:
        raise unreadable(path, error) from None
    if changed:
        then, now = (
            ", ".join(f"{key} {values.get(key)}" for key in changed) for values in (before, origin)
        )
        raise UserError(
            f"{path}: belongs to another run or other code ({then}; now {now}); "
            f"resume with the code that wrote it, or {_AGAIN}"
        )
    return state


def unreadable(path: Path, error: Exception) -> UserError:
    """Return the error for a checkpoint that cannot be read."""
    said = one_line(error) if type(error) is ValueError else type(error).__name__
    return UserError(f"{path}: cannot be read ({said}); {_AGAIN}")
