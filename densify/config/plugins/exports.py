# SPDX-License-Identifier: MIT
"""The forms in which `densify export` writes a finished run. Each has the function
`densify.outputs.export.ExportModule`; the module of another package also has OWNED."""

from __future__ import annotations

from dataclasses import dataclass

from densify.config.plugins.table import Row, Table


@dataclass(frozen=True)
class ExportFormat(Row):
    """owned: the files and folders in the export's folder that it may write."""

    owned: tuple[str, ...] = ()


def _built_in(name: str, about: str, *owned: str) -> ExportFormat:
    module = f"densify.outputs.export.{name.replace('-', '_')}"
    return ExportFormat(name, module, about, owned=owned)


_FLOATS = ("depth", "depth_filled", "confidence")

EXPORTS = Table(
    "export",
    "densify.exports",
    ("write_export",),
    (
        _built_in(
            "png", "the maps as the run has them", "depth", "depth_filled", "confidence", "age"
        ),
        _built_in("npy", "maps, float32 metres", *_FLOATS),
        _built_in("tiff", "maps, float32 metres", *_FLOATS),
        _built_in("exr", "maps, float32 metres", *_FLOATS),
        _built_in("ply", "the cloud, all columns", "cloud.ply"),
        _built_in("pcd", "the cloud, all columns", "cloud.pcd"),
        _built_in("copc", "the cloud for viewers in a browser", "cloud.copc.laz"),
        _built_in("e57", "the cloud with colour and intensity", "cloud.e57"),
        _built_in(
            "nerfstudio",
            "images, cameras, depth and cloud",
            "transforms.json",
            "images",
            "depth",
            "cloud.ply",
        ),
        _built_in(
            "colmap", "images, cameras and points, binary and text", "images", "sparse", "text"
        ),
        _built_in(
            "splats",
            "what Gaussian splatting starts from, movers apart in their own frames",
            "images",
            "sparse",
            "movers",
            "tracks.json",
        ),
        _built_in("tracks", "where moving objects were, CSV and JSON", "tracks.csv", "tracks.json"),
        _built_in("kitti-tracking", "the same as label lines", "label"),
        _built_in(
            "kitti",
            "maps, images and intrinsics in the tree of KITTI depth completion",
            "train",
            "val",
        ),
        _built_in(
            "nuscenes",
            "cloud, images and depth as detectors on nuScenes read them",
            "samples",
            "depth_gt",
            "depth_gt_filled",
        ),
        _built_in("rrd", "one key or several over time, for rerun's viewer", "recording.rrd"),
        _built_in("mcap", "the same for Foxglove", "recording.mcap"),
    ),
)
