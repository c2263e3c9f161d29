# SPDX-License-Identifier: MIT
"""Maps as OpenEXR of one 32-bit floating-point channel, ``Z`` for depth and ``Y`` for confidence,
losslessly compressed."""

from __future__ import annotations

from pathlib import Path

from densify.geometry.types import Float32
from densify.outputs.export.finished_run import FinishedRun
from densify.outputs.export.float_maps import write_maps
from densify.readers.extras import needed


def write_export(run: FinishedRun, folder: Path) -> None:
    """``depth/CAMERA.exr`` and so on, see `write_maps`. Raises InputError without OpenEXR."""
    library = needed("OpenEXR", "exr", "EXR files")

    def write(path: Path, values: Float32) -> None:
        channel = "Y" if path.is_relative_to(folder / "confidence") else "Z"
        header = {"compression": library.ZIP_COMPRESSION, "type": library.scanlineimage}
        library.File(header, {channel: values}).write(str(path))

    write_maps(run, folder, ".exr", write)
