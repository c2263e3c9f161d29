# SPDX-License-Identifier: MIT
"""Dense depth maps from lidar recordings, with the moving objects kept sharp.

Names are imported on first use, so ``import densify`` costs nothing and loads no torch::

    import densify

    sequence = densify.open_sequence("street")
    result = densify.run(sequence, key=120, window=5)
    result.depth["image_02"].depth_m  # (H,W) float32 metres, 0 none
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from densify.config import Config as Config
    from densify.dataset.gate import Gate as Gate
    from densify.dataset.loader import DepthDataset as DepthDataset
    from densify.dataset.make import make_dataset as make_dataset
    from densify.dataset.plan import Recipe as Recipe
    from densify.errors import ComputationError as ComputationError
    from densify.errors import InputError as InputError
    from densify.flow.pairs.estimate import estimate_flow as estimate_flow
    from densify.pipeline import compare as compare
    from densify.pipeline import run as run
    from densify.readers import open_sequence as open_sequence
    from densify.types import Camera as Camera
    from densify.types import Cloud as Cloud
    from densify.types import DepthMap as DepthMap
    from densify.types import FlowField as FlowField
    from densify.types import LidarSequence as LidarSequence
    from densify.types import Result as Result
    from densify.types import Sweep as Sweep

from densify.version import __version__ as __version__

_HOME = {
    "open_sequence": "densify.readers",
    "run": "densify.pipeline",
    "compare": "densify.pipeline",
    "estimate_flow": "densify.flow.pairs.estimate",
    "make_dataset": "densify.dataset.make",
    "Recipe": "densify.dataset.plan",
    "Gate": "densify.dataset.gate",
    "Config": "densify.config",
    "InputError": "densify.errors",
    "ComputationError": "densify.errors",
    "Camera": "densify.types",
    "Cloud": "densify.types",
    "DepthDataset": "densify.dataset.loader",
    "DepthMap": "densify.types",
    "FlowField": "densify.types",
    "LidarSequence": "densify.types",
    "Result": "densify.types",
    "Sweep": "densify.types",
}


def __getattr__(name: str) -> Any:
    if name not in _HOME:
        raise AttributeError(f"module 'densify' has no attribute {name!r}")
    return getattr(import_module(_HOME[name]), name)


def __dir__() -> list[str]:
    return sorted([*_HOME, "__version__"])
