# SPDX-License-Identifier: MIT
"""The notebook runs from top to bottom, and says what it should."""

from __future__ import annotations

import ast
import json
import re
from pathlib import Path
from typing import Any

import cv2
import numpy as np

NOTEBOOK = Path(__file__).parents[1] / "examples" / "your_data.ipynb"


def run_cells() -> list[Any]:
    """Return the value of the last expression of each cell of code, as the notebook shows it."""
    names: dict[str, Any] = {}
    shown = []
    for cell in json.loads(NOTEBOOK.read_text("utf-8"))["cells"]:
        if cell["cell_type"] == "code":
            lines = ast.parse("".join(cell["source"])).body
            last = lines.pop() if isinstance(lines[-1], ast.Expr) else None
            exec(compile(ast.Module(lines, []), NOTEBOOK.name, "exec"), names)
            if isinstance(last, ast.Expr):
                code = compile(ast.Expression(last.value), NOTEBOOK.name, "eval")
                shown.append(eval(code, names))
    return shown


def test_your_data(tmp_path: Path, monkeypatch, capsys) -> None:
    monkeypatch.delenv("DENSIFY_DATA", raising=False)
    monkeypatch.delenv("DENSIFY_KEY", raising=False)
    monkeypatch.chdir(tmp_path)
    shown, text = run_cells(), capsys.readouterr().out
    (png,) = (value.data for value in shown if hasattr(value, "data"))
    figure = cv2.imdecode(np.frombuffer(png, np.uint8), cv2.IMREAD_COLOR)
    assert figure.shape[0] > 200 and figure.std() > 20
    assert "fine" in text and "open first:" in text
    ghosts, alone = map(float, re.findall(r"ghosts: ([\d.]+)%, .* ([\d.]+)%", text)[0])
    assert ghosts < alone
    (cloud,) = tmp_path.rglob("cloud.ply")
    assert cloud.read_bytes().startswith(b"ply")
