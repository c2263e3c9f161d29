# SPDX-License-Identifier: MIT
"""Add pages of the repository's root, and the notebook, to the site: a hook of mkdocs."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from mkdocs.structure.files import File, Files

PAGES = ("CONTRIBUTING.md", "CHANGES.md", "SECURITY.md")


def on_files(files: Files, config: Any) -> Files:
    """Return the files of the site with these pages, whose links are relative to docs/."""
    root = Path(config.config_file_path).parent
    for name in PAGES:
        text = (root / name).read_text("utf-8").replace("](docs/", "](")
        text = text.replace("](docs)", "](index.md)").replace("](README.md)", "](index.md)")
        files.append(File.generated(config, name, content=text))
    notebook = root / "examples/your_data.ipynb"
    files.append(File.generated(config, notebook.name, content=notebook.read_bytes()))
    return files
