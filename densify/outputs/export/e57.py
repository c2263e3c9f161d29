# SPDX-License-Identifier: MIT
"""The cloud as E57 (ASTM E2807) for surveyors' tools, by pye57 (``densify[e57]``)."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from densify.config.errors import InputError
from densify.outputs.export.finished_run import FinishedRun
from densify.readers.extras import needed


def write_export(run: FinishedRun, folder: Path) -> None:
    """``cloud.e57``: one scan of places (float32 metres, key frame), colours and intensity, the
    columns that the format has. Its identifiers are new every time, so bytes differ. Raises
    InputError without pye57, or if nothing is left of the cloud, which the format cannot say."""
    pye57 = needed("pye57", "e57", "E57 files")
    cloud = run.cloud()
    if not len(cloud.points):
        raise InputError(f"{run.folder}: nothing is left of the cloud; lower --min-confidence")
    columns = dict(zip(("cartesianX", "cartesianY", "cartesianZ"), cloud.points.T, strict=True))
    columns |= dict(zip(("colorRed", "colorGreen", "colorBlue"), cloud.rgb.T, strict=True))
    columns |= {"intensity": cloud.intensity}
    columns |= {"cartesianInvalidState": np.zeros(len(cloud.points), np.int8)}
    file = pye57.E57(str(folder / "cloud.e57"), mode="w")
    file.write_scan_raw(columns, name=f"key {run.key}")
    file.close()
