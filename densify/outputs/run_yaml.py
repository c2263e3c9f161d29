# SPDX-License-Identifier: MIT
"""The output of how a result was made, run.yaml."""

from __future__ import annotations

import platform
from dataclasses import asdict
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from densify import __version__
from densify.geometry.types import Result
from densify.outputs.atomic import write_file
from densify.outputs.context import Context
from densify.outputs.plain import plain

_PACKAGES = (
    "numpy",
    "scipy",
    "torch",
    "embreex",
    "kiss-icp",
    "small-gicp",
    "opencv-python-headless",
    "laspy",
    "lazrs",
    "PyYAML",
)


def write_output(result: Result, context: Context, folder: Path) -> None:
    """``run.yaml``: data, key, frames, those beyond the window, cameras, warnings, how priors fit,
    configuration, cost of each stage, versions, how what is beyond the window was registered."""
    record = {
        "data": context.data,
        "key": result.key,
        "method": result.method,
        "frames": result.frames,
        "far_frames": result.far_frames,
        "cameras": list(result.depth),
        "prior": {
            name: {"source": full.source, **asdict(full.fit), "share": full.share}
            for name, full in result.full.items()
        },
        "warnings": result.warnings,
        "config": context.config,
        "stages": stages(result),
        "versions": versions(),
    }
    text = yaml.safe_dump(plain(record), sort_keys=False, allow_unicode=True)
    text += yaml.safe_dump({"far_links": _far_links(result)}, default_flow_style=None, width=200)
    write_file(folder / "run.yaml", text.encode())


def _far_links(result: Result) -> dict[str, Any]:
    """A row for each pair of submaps, and the names of its columns (`Links`)."""
    links = result.far_links
    names = ("overlap", "rms_m", "num_matches", "correction_m", "correction_deg", "left_m")
    columns = [*links.frames.T, *(np.round(getattr(links, name), 4) for name in names)]
    return {
        "left_out": list(result.far_left_out),
        "columns": ["target", "source", *names],
        "pairs": [list(row) for row in zip(*(c.tolist() for c in columns), strict=True)],
    }


def stages(result: Result) -> list[dict[str, Any]]:
    """What each stage cost: name, seconds, peak_memory_mb."""
    return [
        {
            "name": cost.name,
            "seconds": round(cost.seconds, 3),
            "peak_memory_mb": round(cost.peak_memory_mb, 1),
        }
        for cost in result.costs
    ]


def versions() -> dict[str, str | None]:
    """Versions of densify, Python, the platform and the packages that results depend on."""
    found: dict[str, str | None] = {
        "densify": __version__,
        "python": platform.python_version(),
        "platform": platform.platform(),
    }
    for package in _PACKAGES:
        try:
            found[package] = version(package)
        except PackageNotFoundError:  # conda and system builds go by other names
            found[package] = None
    return found
