"""Checkpoints from which a stopped run resumes, if they are whole and of the same run and code."""

from __future__ import annotations

import hashlib
import io
from pathlib import Path
from typing import Any

import torch

from ril.io.errors import UserError, one_line
from ril.io.files import tensor_bytes, write_atomically

#: First line of the file; its number rises whenever earlier files can no longer be resumed.
_HEAD = b"ril checkpoint 2\n"
_DIGEST = hashlib.sha256().digest_size
_AGAIN = "delete it, or give resume=false, to start again"


def save_checkpoint(path: Path, origin: dict[str, str], state: dict[str, Any]) -> None:
    """Write all that the rest of a run depends on.

    Args:
        path: of the file.
        origin: what must be the same when the run resumes; see `ril.run.provenance.origin`.
        state: tensors and plain values.

    Raises:
        WriteError: it cannot be written; the checkpoint before is kept.
    """
    content = tensor_bytes({"origin": origin, "state": state})
    # Reading tensors checks no sums, so a damaged number would go unseen.
    write_atomically(path, _HEAD, hashlib.sha256(content).digest(), content)


def load_checkpoint(path: Path, origin: dict[str, str]) -> dict[str, Any]:
    """Read a checkpoint of the same run by the same code; nothing in it is executed.

    Args:
        path: of the file.
        origin: of this run.

    Returns:
        The state that was saved.

    Raises:
        UserError: it is damaged, or not of this run or this code.
    """
    try:
        data = path.read_bytes()
        if not data.startswith(_HEAD):
            known = data.startswith(_HEAD[: _HEAD.rindex(b" ")])
            raise ValueError("of another version of ril" if known else "not a checkpoint of ril")
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
            f"{path}: is of another run or other code ({then}; now {now}); "
            f"resume with the code that wrote it, or {_AGAIN}"
        )
    return state


def unreadable(path: Path, error: Exception) -> UserError:
    """Return the error of a file from which a run cannot resume."""
    said = one_line(error) if type(error) is ValueError else type(error).__name__
    return UserError(f"{path}: cannot be read ({said}); {_AGAIN}")
