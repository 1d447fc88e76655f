"""Hook of MkDocs: list every page of docs/methods/ in the navigation."""

from __future__ import annotations

from pathlib import Path
from typing import Any


def on_config(config: Any) -> Any:
    """Fill the section "Methods" with the overview and a page per method, in alphabetical order."""
    pages = sorted(file.name for file in (Path(config.docs_dir) / "methods").glob("*.md"))
    names = [name for name in pages if name != "index.md"]
    for section in config.nav:
        if "Methods" in section:
            section["Methods"] = [
                {"Overview": "methods/index.md"},
                *({name.removesuffix(".md"): f"methods/{name}"} for name in names),
            ]
    return config
