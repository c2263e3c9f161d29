# SPDX-License-Identifier: MIT
"""A small run and comparison on disk for the tests of pages: one camera, one car, truth."""

from __future__ import annotations

from functools import cache
from pathlib import Path

from densify.config import as_mapping, resolve
from densify.geometry.types import Result
from densify.outputs.key_outputs import write_comparison, write_result
from densify.pipeline.run import compare
from tests.small_street import KEY, POSES_GIVEN, one_car

CONFIG = POSES_GIVEN | {"output": {"report": True, "rejected": True}}
FOLDER = f"{KEY:06d}"


@cache
def results() -> dict[str, Result]:
    return compare(one_car(), KEY, 2, config=CONFIG, methods=("none", "icp", "flow"))


def write_run(out: Path, report: bool = True) -> Path:
    """The key's folder."""
    result = results()["flow"]
    config = as_mapping(resolve(CONFIG))
    if not report:
        config = {**config, "output": {**config["output"], "report": False}}
    write_result(result, out, config=config, data="tiny street")
    return out / FOLDER


def write_compared(out: Path) -> Path:
    config = as_mapping(resolve(POSES_GIVEN))
    write_comparison(results(), out, config=config, data="tiny street")
    return out / FOLDER
