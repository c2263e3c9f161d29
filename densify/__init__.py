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
    from densify.scores.metrics import outlier_probability as outlier_probability

_NAMES = {
    "densify.config": "Config",
    "densify.config.errors": "ComputationError InputError",
    "densify.dataset.loader": "DepthDataset",
    "densify.dataset.make": "make_dataset",
    "densify.dataset.manifest": "manifest",
    "densify.dataset.plan": "Gate Recipe",
    "densify.flow.two_clouds": "estimate_flow",
    "densify.geometry.types": "Camera Cloud DepthMap FlowField LidarSequence Result Sweep",
    "densify.outputs.finished_run": "load_result",
    "densify.pipeline.run": "compare run run_keys",
    "densify.readers": "open_sequence",
    "densify.scores.metrics": "outlier_probability",
}
_HOME = {name: module for module, names in _NAMES.items() for name in names.split()}


def __getattr__(name: str) -> Any:
    if name not in _HOME:
        raise AttributeError(f"module 'densify' has no attribute {name!r}")
    return getattr(import_module(_HOME[name]), name)


def __dir__() -> list[str]:
    return sorted([*_HOME, "__version__"])
