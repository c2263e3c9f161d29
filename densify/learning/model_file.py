# SPDX-License-Identifier: MIT
"""The one door to files of networks: numpy's archive of arrays, read without running any code.

A member ``header`` holds JSON (format, version, network, how it was trained); ``weights/NAME`` are
the network's arrays; a checkpoint has more beside them. The file's name may be anything.
"""

from __future__ import annotations

import io
import json
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from densify.config.errors import InputError
from densify.config.file_content import parse_json
from densify.flow.objective.energy import on_one_thread
from densify.geometry.types import Float
from densify.learning.clouds import Sweeps
from densify.learning.network import Voxels, build
from densify.outputs.atomic import write_file
from densify.readers.decoded_files import read_arrays

FORMAT, VERSION = "densify model", 1
NETWORK = "voxels"
_HEADER, _WEIGHTS = "header", "weights/"


@dataclass(frozen=True)
class Model:
    """A network with its weights.

    made: how it was trained, plain values for JSON. beside: arrays that a checkpoint keeps beside
    the weights, by name.
    """

    network: Voxels
    made: Mapping[str, Any] = field(default_factory=dict)
    beside: Mapping[str, NDArray[Any]] = field(default_factory=dict)

    def flow(self, sweeps: Sweeps) -> Float:
        """Return the (n,3) flow of the first sweep to the second, metres; the same bytes on any
        number of cores."""
        with on_one_thread(), torch.inference_mode():
            found: Float = self.network(sweeps).double().numpy()
        return found


def write_model(path: Path, model: Model) -> None:
    """Write a model file: the same bytes for the same model.

    The file appears when it is complete. Raises OutputError where it cannot be written.
    """
    header = {"format": FORMAT, "version": VERSION, "network": NETWORK, "made": model.made}
    text = json.dumps(header, sort_keys=True).encode()
    arrays: dict[str, NDArray[Any]] = {_HEADER: np.frombuffer(text, np.uint8)}
    for name, tensor in model.network.state_dict().items():
        arrays[_WEIGHTS + name] = tensor.detach().cpu().numpy()
    arrays.update(model.beside)
    buffer = io.BytesIO()
    np.savez(buffer, **arrays)  # type: ignore[arg-type]
    write_file(path, buffer.getvalue())


def read_model(path: Path) -> Model:
    """Read a model file. Raises InputError for another file, a damaged one, or another version."""
    if not path.is_file():
        raise InputError(f"{path}: no such file; expected a model that densify train flow wrote")
    arrays = read_arrays(path)
    try:
        header = dict(parse_json(bytes(arrays.pop(_HEADER).astype(np.uint8)), path))
        found = header["format"], header["version"], header["network"]
        made = dict(header["made"])
    except (KeyError, ValueError, TypeError, InputError):
        raise InputError(f"{path}: no model that densify train flow wrote") from None
    if found != (FORMAT, VERSION, NETWORK):
        raise InputError(
            f"{path}: got {found}, expected {(FORMAT, VERSION, NETWORK)}; train it again"
        )
    network = build()
    names = [name for name in arrays if name.startswith(_WEIGHTS)]
    weights = {name.removeprefix(_WEIGHTS): arrays.pop(name) for name in names}
    if not all(np.isfinite(array).all() for array in weights.values()):
        raise InputError(f"{path}: weights that are not finite; train it again")
    try:
        network.load_state_dict({name: torch.from_numpy(a) for name, a in weights.items()})
    except (RuntimeError, TypeError) as error:
        raise InputError(f"{path}: damaged: {error}; train it again") from error
    return Model(network.train(False), made, arrays)
