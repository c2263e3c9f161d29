# SPDX-License-Identifier: MIT
"""The forms in which `densify export` writes a finished run: a function each, as
`densify.outputs.export.WriteExport`. The module of another package has ``write_export`` and OWNED.
"""

from __future__ import annotations

from dataclasses import dataclass

from densify.config.plugins.table import Row, Table


@dataclass(frozen=True)
class ExportFormat(Row):
    """function: of the module. owned: the files and folders in the export's folder that it may
    write. of_drive: takes several keys of a drive too."""

    function: str = "write_export"
    owned: tuple[str, ...] = ()
    of_drive: bool = False


def _built_in(
    name: str, module: str, about: str, *owned: str, of_drive: bool = False
) -> ExportFormat:
    path = f"densify.outputs.export.{module}"
    return ExportFormat(name, path, f"write_{name}", owned, of_drive, about=about)


_MAPS = ("depth", "depth_filled", "confidence")
_NERFSTUDIO = ("transforms.json", "images", "depth", "cloud.ply")
_SPLATS = "what Gaussian splatting starts from, moving objects in their own frames"
_KITTI = "maps, images and intrinsics in the tree of KITTI depth completion"
_RRD = "one key or several over time, for rerun's viewer"

EXPORTS = Table(
    "export",
    "densify.exports",
    ("write_export",),
    (
        _built_in("npy", "maps_and_clouds", "maps, float32 metres", *_MAPS),
        _built_in("exr", "maps_and_clouds", "maps, float32 metres", *_MAPS),
        _built_in("ply", "maps_and_clouds", "the cloud, all columns", "cloud.ply"),
        _built_in("pcd", "maps_and_clouds", "the cloud, all columns", "cloud.pcd"),
        _built_in("nerfstudio", "camera_files", "images, cameras, depth and cloud", *_NERFSTUDIO),
        _built_in("colmap", "camera_files", "images, cameras and points", "images", "sparse"),
        _built_in("splats", "camera_files", _SPLATS, "images", "sparse", "movers", "tracks.json"),
        _built_in("kitti", "maps_and_clouds", _KITTI, "train", "val", of_drive=True),
        _built_in("rrd", "rrd", _RRD, "recording.rrd", of_drive=True),
        _built_in("mcap", "mcap", "the same for Foxglove", "recording.mcap", of_drive=True),
    ),
)
