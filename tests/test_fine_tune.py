# SPDX-License-Identifier: MIT
"""The losses that docs/fine-tune.md gives leave out the pixels without a depth."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import pytest
import torch

PAGE = Path(__file__).resolve().parent.parent / "docs/fine-tune.md"


@pytest.fixture(scope="module")
def losses() -> dict[str, Any]:
    blocks = re.findall(r"```python\n(.*?)```", PAGE.read_text(), flags=re.DOTALL)
    found: dict[str, Any] = {}
    exec(next(block for block in blocks if "log_loss" in block), found)
    return found


@pytest.fixture
def dense_m() -> torch.Tensor:
    torch.manual_seed(0)
    depth_m = 4 + 70 * torch.rand(2, 1, 8, 9)
    return torch.where(torch.rand(2, 1, 8, 9) < 0.4, depth_m, torch.zeros(()))


@pytest.mark.parametrize("name", ("log_loss", "invariant_loss"))
def test_pixels_without_depth_do_not_count(
    losses: dict[str, Any], dense_m: torch.Tensor, name: str
) -> None:
    predicted = torch.rand(2, 1, 8, 9).add(1).requires_grad_()
    loss = losses[name](predicted, dense_m)
    loss.backward()
    assert predicted.grad is not None
    assert not predicted.grad[dense_m == 0].any() and predicted.grad[dense_m > 0].any()
    other = torch.where(dense_m > 0, predicted.detach(), torch.full((), 7.0))
    assert losses[name](other, dense_m) == pytest.approx(loss.item())
    assert losses[name](other, torch.zeros_like(dense_m)) == 0  # no pixel is known


def test_the_right_depth_has_no_loss(losses: dict[str, Any], dense_m: torch.Tensor) -> None:
    assert losses["log_loss"](dense_m, dense_m) == 0
    inverse = 1 / dense_m.clamp(min=0.1)
    assert losses["invariant_loss"](3 * inverse + 2, dense_m) == pytest.approx(0, abs=1e-5)
    assert losses["log_loss"](2 * dense_m, dense_m) == pytest.approx(0.6931, abs=1e-4)
