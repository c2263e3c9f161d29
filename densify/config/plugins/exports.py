# SPDX-License-Identifier: MIT
"""The forms in which `densify export` writes a finished run.

To add one, write a module with the function that `densify.outputs.export.ExportModule` describes
(and that of `densify.outputs.export.DriveModule`, if it takes several keys) and one row here. In a
package of your own an entry point in the group ``densify.exports`` takes the row's place, and
``OWNED`` of the module says what the row's ``owned`` says.
"""

from __future__ import annotations

from dataclasses import dataclass
from types import ModuleType

from densify.config.plugins.table import Table


@dataclass(frozen=True)
class ExportFormat:
    """owned: the files and folders in the export's folder that it may write. about: what it
    writes, for the help."""

    name: str
    module: str
    owned: tuple[str, ...]
    about: str

    @property
    def usage(self) -> str:
        """How ``--to`` names it."""
        return self.name


def _row(name: str, module: ModuleType, version: str) -> ExportFormat:
    owned = tuple(getattr(module, "OWNED", ()))
    return ExportFormat(name, module.__name__, owned, about="of another package")


_HERE = "densify.outputs.export."
_FLOATS = ("depth", "depth_filled", "confidence")

EXPORTS = Table(
    kind="export",
    group="densify.exports",
    built_in=(
        ExportFormat(
            "png",
            _HERE + "png",
            owned=("depth", "depth_filled", "confidence", "age"),
            about="the maps as the run has them",
        ),
        ExportFormat("npy", _HERE + "npy", owned=_FLOATS, about="maps, float32 metres"),
        ExportFormat("tiff", _HERE + "tiff", owned=_FLOATS, about="maps, float32 metres"),
        ExportFormat("exr", _HERE + "exr", owned=_FLOATS, about="maps, float32 metres"),
        ExportFormat("ply", _HERE + "ply", owned=("cloud.ply",), about="the cloud, all columns"),
        ExportFormat("pcd", _HERE + "pcd", owned=("cloud.pcd",), about="the cloud, all columns"),
        ExportFormat(
            "copc",
            _HERE + "copc",
            owned=("cloud.copc.laz",),
            about="the cloud for viewers in a browser",
        ),
        ExportFormat(
            "e57", _HERE + "e57", owned=("cloud.e57",), about="the cloud with colour and intensity"
        ),
        ExportFormat(
            "nerfstudio",
            _HERE + "nerfstudio",
            owned=("transforms.json", "images", "depth", "cloud.ply"),
            about="images, cameras, depth and cloud",
        ),
        ExportFormat(
            "colmap",
            _HERE + "colmap",
            owned=("images", "sparse", "text"),
            about="images, cameras and points, binary and text",
        ),
        ExportFormat(
            "splats",
            _HERE + "splats",
            owned=("images", "sparse", "movers", "tracks.json"),
            about="what Gaussian splatting starts from, movers apart in their own frames",
        ),
        ExportFormat(
            "tracks",
            _HERE + "tracks",
            owned=("tracks.csv", "tracks.json"),
            about="where moving objects were, CSV and JSON",
        ),
        ExportFormat(
            "kitti-tracking",
            _HERE + "kitti_tracking",
            owned=("label",),
            about="the same as label lines",
        ),
        ExportFormat(
            "kitti",
            _HERE + "kitti",
            owned=("train", "val"),
            about="maps, images and intrinsics in the tree of KITTI depth completion",
        ),
        ExportFormat(
            "nuscenes",
            _HERE + "nuscenes",
            owned=("samples", "depth_gt", "depth_gt_filled"),
            about="cloud, images and depth as detectors on nuScenes read them",
        ),
        ExportFormat(
            "rrd",
            _HERE + "rrd",
            owned=("recording.rrd",),
            about="one key or several over time, for rerun's viewer",
        ),
        ExportFormat(
            "mcap",
            _HERE + "mcap",
            owned=("recording.mcap",),
            about="the same for Foxglove",
        ),
    ),
    members=("write_export",),
    row_of=_row,
)
