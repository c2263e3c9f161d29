# SPDX-License-Identifier: MIT
"""The notebooks run from top to bottom, and say what they should."""

from __future__ import annotations

import base64
import re
from pathlib import Path
from typing import Any

import cv2
import nbformat
import numpy as np
from nbclient import NotebookClient

EXAMPLES = Path(__file__).parents[1] / "examples"


def run(name: str, folder: Path) -> tuple[str, list[np.ndarray[Any, Any]]]:
    """What its cells print, and the pictures they show."""
    notebook = nbformat.read(EXAMPLES / name, 4)
    where = {"metadata": {"path": str(folder)}}
    NotebookClient(notebook, timeout=600, resources=where).execute()
    outputs = [o for cell in notebook.cells for o in cell.get("outputs", [])]
    texts = [o.get("text") or o.get("data", {}).get("text/plain", "") for o in outputs]
    coded = [data for o in outputs for kind, data in o.get("data", {}).items() if "image/" in kind]
    pixels = [np.frombuffer(base64.b64decode(data), np.uint8) for data in coded]
    return "\n".join(texts), [cv2.imdecode(p, cv2.IMREAD_COLOR) for p in pixels]


def test_your_data(tmp_path: Path, monkeypatch) -> None:
    monkeypatch.delenv("DENSIFY_DATA", raising=False)
    monkeypatch.delenv("DENSIFY_KEY", raising=False)
    text, (figure,) = run("your_data.ipynb", tmp_path)
    assert figure.shape[0] > 200 and figure.std() > 20
    assert "fine" in text and "open first:" in text
    ghosts, alone = map(float, re.findall(r"ghosts: ([\d.]+)%, .* ([\d.]+)%", text)[0])
    assert ghosts < alone
    (cloud,) = tmp_path.rglob("cloud.ply")
    assert cloud.read_bytes().startswith(b"ply")
