# SPDX-License-Identifier: MIT
"""The notebook runs from top to bottom, and says what it should."""

from __future__ import annotations

import ast
import json
import re
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

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
    (picture,) = (np.asarray(value) for value in shown if isinstance(value, Image.Image))
    assert picture.shape[0] > 200 and picture.std() > 20
    assert "fine" in text and "frames 116 to 120" in text
    ghosts, alone = map(float, re.findall(r"ghosts: ([\d.]+)%, .* ([\d.]+)%", text)[0])
    assert ghosts < alone
    assert np.load("depth.npy").shape == (375, 1242)
    assert len(np.load("cloud.npy")) > 100_000
    cells = json.loads(NOTEBOOK.read_text("utf-8"))["cells"]
    stored = [output for cell in cells for output in cell.get("outputs", ())]
    assert sum("image/png" in output.get("data", {}) for output in stored) == 1
