# SPDX-License-Identifier: MIT
"""Dense depth maps from lidar recordings, with the moving objects kept sharp.

Names are imported on first use, so ``import densify`` loads no torch::

    import densify

    sequence = densify.open_sequence("street")
    result = densify.run(sequence, key=120, window=5)
    result.depth["image_02"].depth_m  # (H,W) float32 metres, 0 for no depth

`InputError` means that something given is missing, damaged, unknown or out of range, and its
subclass `OutputError` that a file cannot be written. `ComputationError` means that a stage's result
is not reliable. A message is one line: what happened, where, what was expected, what to do.
Docstrings name an error if its cause cannot be guessed from the arguments.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

from densify.version import __version__ as __version__

if TYPE_CHECKING:
    from densify.config import Config as Config
    from densify.config.errors import ComputationError as ComputationError
    from densify.config.errors import InputError as InputError
    from densify.dataset.loader import DepthDataset as DepthDataset
    from densify.dataset.make import make_dataset as make_dataset
    from densify.dataset.manifest import manifest as manifest
    from densify.dataset.plan import Gate as Gate
    from densify.dataset.plan import Recipe as Recipe
    from densify.flow.two_clouds import estimate_flow as estimate_flow
    from densify.geometry.types import Camera as Camera
    from densify.geometry.types import Cloud as Cloud
    from densify.geometry.types import DepthMap as DepthMap
    from densify.geometry.types import FlowField as FlowField
    from densify.geometry.types import LidarSequence as LidarSequence
    from densify.geometry.types import Result as Result
    from densify.geometry.types import Sweep as Sweep
    from densify.outputs.finished_run import load_result as load_result
    from densify.pipeline.run import compare as compare
    from densify.pipeline.run import run as run
    from densify.pipeline.run import run_keys as run_keys
    from densify.readers import open_sequence as open_sequence
    from densify.scores.depth_metrics import outlier_probability as outlier_probability

_HOME = {
    "open_sequence": "densify.readers",
    "run": "densify.pipeline.run",
    "compare": "densify.pipeline.run",
    "estimate_flow": "densify.flow.two_clouds",
    "make_dataset": "densify.dataset.make",
    "manifest": "densify.dataset.manifest",
    "load_result": "densify.outputs.finished_run",
    "run_keys": "densify.pipeline.run",
    "Recipe": "densify.dataset.plan",
    "outlier_probability": "densify.scores.depth_metrics",
    "Gate": "densify.dataset.plan",
    "Config": "densify.config",
    "InputError": "densify.config.errors",
    "ComputationError": "densify.config.errors",
    "Camera": "densify.geometry.types",
    "Cloud": "densify.geometry.types",
    "DepthDataset": "densify.dataset.loader",
    "DepthMap": "densify.geometry.types",
    "FlowField": "densify.geometry.types",
    "LidarSequence": "densify.geometry.types",
    "Result": "densify.geometry.types",
    "Sweep": "densify.geometry.types",
}


def __getattr__(name: str) -> Any:
    if name not in _HOME:
        raise AttributeError(f"module 'densify' has no attribute {name!r}")
    return getattr(import_module(_HOME[name]), name)


def __dir__() -> list[str]:
    return sorted([*_HOME, "__version__"])
