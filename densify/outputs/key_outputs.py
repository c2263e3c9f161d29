# SPDX-License-Identifier: MIT
"""Write the files of one densified sweep: depth maps, cloud, metrics.json, movers.json, scene/.

Fields of metrics.json, null where unknown. compare.json has those from ``frames`` on by method::

    schema_version, key (frame number of the sweep), method
    frames      frame numbers of the window
    num_points  number of points in the cloud; num_moving: number of moving points
    density     camera -> measured, filled: share of the pixels with a depth; with --prior also
                full (completed map), and prior, the share of pixels that came from the prior
    ghosts      `densify.scores.cloud_scores.ghost_scores`
    depth       with ground truth: camera -> measured, filled (full, prior) -> all, moving, static
                -> `densify.scores.depth_metrics.DepthErrors`
    measure     map -> z, depth along the camera's axis, or range, distance from the lens
    held_out    camera -> as depth: map made without the key sweep, against its returns; curve,
                `precision_density`; reliability, `densify.depth.confidence`;
                unjudged, share of the filled pixels near which the key sweep has no return
    reliability with ground truth: map -> the same list against ground truth
    expected_outliers  map -> measured, filled: the share of outliers that confidence predicts
    baselines   simpler method on the same registration -> the fields from ``frames`` on

movers.json: objects, by `ObjectTrack`: instance (as in cloud.laz), size_m (length, width, height
of the completed box), seen_size_m (of the box around its points), sides_seen, and poses at its
sweeps and the key sweep: frame, stamp_ns, num_points, T_key_object (4,4), velocity_m_s (3,) without
ego-motion, in the key sweep's lidar frame.

scene/::

    image/CAMERA.jpg   the image that the map shows
    none/CAMERA.png, icp/…, truth/…   depth of the simpler methods, and true depth, as in ``depth``
    sweep/CAMERA.png   uint16, measured pixels: 1 + index of the source sweep in ``sweeps``; 0 none
    reason/CAMERA.png  uint8 `Reason` that the nearest point of a pixel was rejected
    scene.json         sweeps: frame, since_key_s, far, T_key_lidar (4,4); views: map -> camera,
                       T_cam_key (4,4), late_s after the key sweep, image number
"""

from __future__ import annotations

import platform
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import asdict, dataclass
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from densify.geometry.types import Result
from densify.outputs.atomic import plain, write_file, write_json
from densify.outputs.cloud_laz import write_cloud
from densify.outputs.depth_png import (
    encode_jpeg,
    encode_png,
    map_path,
    write_age_png,
    write_confidence_png,
    write_depth_png,
    write_flow_png,
)
from densify.version import __version__

SCHEMA_VERSION = 1
"""Version of each JSON file. It grows when a field changes its meaning or is removed."""
_PACKAGES = (
    *("numpy", "scipy", "torch", "embreex", "kiss-icp", "small-gicp", "opencv-python-headless"),
    *("laspy", "lazrs", "PyYAML"),
)


@dataclass(frozen=True)
class Context:
    """Describe how a result was asked for. Each output function gets it beside the result."""

    config: Mapping[str, Any]  # the merged configuration as plain mappings, by section
    data: str  # specification of the recording, as the user gave it


def write_depth(result: Result, context: Context, folder: Path) -> None:
    """Write the maps ``depth``, ``depth_filled``, ``confidence`` and ``age`` of each camera.

    Age is the time from exposure to the sweep that measured the pixel or, if filled, the nearest.
    """
    for camera, depth in result.depth.items():
        if depth.age_s is None:
            raise ValueError(f"depth map of {camera}: expected ages (with_ages)")
        write_depth_png(map_path(folder, "depth", camera), depth.depth_m)
        write_depth_png(map_path(folder, "depth_filled", camera), depth.filled_m)
        path = map_path(folder, "confidence", camera)
        write_confidence_png(path, depth.confidence, depth.filled_m)
        write_age_png(map_path(folder, "age", camera), depth.age_s, depth.filled_m)


def write_full(result: Result, context: Context, folder: Path) -> None:
    """Write ``depth_full``, depth completed with the user's prior, and ``confidence_full``."""
    for camera, full in result.full.items():
        write_depth_png(map_path(folder, "depth_full", camera), full.depth_m)
        path = map_path(folder, "confidence_full", camera)
        # At most 0.2 at pixels whose depth comes from the prior
        write_confidence_png(path, full.confidence, full.depth_m)


def write_optical_flow(result: Result, context: Context, folder: Path) -> None:
    """Write ``optical_flow/previous`` and ``optical_flow/next`` of maps with optical flow."""
    for camera, flows in result.optical_flow.items():
        for other, flow_px in flows.items():
            write_flow_png(map_path(folder / "optical_flow", other, camera), flow_px)


def write_cloud_laz(result: Result, context: Context, folder: Path) -> None:
    """Write the accumulated cloud as ``cloud.laz``."""
    write_cloud(folder / "cloud.laz", result.cloud, result.stamp_ns)


def write_movers(result: Result, context: Context, folder: Path) -> None:
    """Write cloud and depth maps of each separated object to ``movers/0007/``."""
    for instance, mover in result.movers.items():
        # others: moving points without an object
        place = folder / "movers" / (f"{instance:04d}" if instance >= 0 else "others")
        for name, maps in mover.depth.items():
            write_depth_png(map_path(place, "depth", name), maps.depth_m)
        write_cloud(place / "cloud.laz", mover.cloud, result.stamp_ns)


def write_metrics(result: Result, context: Context, folder: Path) -> None:
    """Write ``metrics.json``, the scores of the result and of its baselines."""
    table = {
        "schema_version": SCHEMA_VERSION,
        "key": result.key,
        "method": result.method,
        "frames": result.frames,
        **result.metrics,
        "baselines": {m: {"frames": b.frames, **b.metrics} for m, b in result.baselines.items()},
    }
    write_json(folder / "metrics.json", table)


def write_tracks(result: Result, context: Context, folder: Path) -> None:
    """Write ``movers.json``, the poses of moving objects, if the sweeps are registered."""
    if not result.T_key_lidar:
        return
    names = ("stamp_ns", "num_points", "T_key_object", "velocity_m_s")
    objects = []
    for track in result.tracks:
        poses = [
            {"frame": frame, **{name: getattr(track, name)[i] for name in names}}
            for i, frame in enumerate(track.frames)
        ]
        fields = ("instance", "size_m", "seen_size_m", "sides_seen")
        objects.append({**{name: getattr(track, name) for name in fields}, "poses": poses})
    table = {"schema_version": SCHEMA_VERSION, "key": result.key, "objects": objects}
    write_json(folder / "movers.json", table)


def write_run_yaml(result: Result, context: Context, folder: Path) -> None:
    """Write ``run.yaml``, the content of `record`."""
    text = yaml.safe_dump(plain(record(result, context)), sort_keys=False, allow_unicode=True)
    write_file(folder / "run.yaml", text.encode())


def record(result: Result, context: Context) -> dict[str, Any]:
    """Return how a result was made: recording, key, configuration, cost of each stage, versions."""
    versions: dict[str, str | None] = {"densify": __version__, "python": platform.python_version()}
    versions["platform"] = platform.platform()
    for package in _PACKAGES:
        versions[package] = None  # unknown, as in system builds
        with suppress(PackageNotFoundError):
            versions[package] = version(package)
    return {
        "recording": result.recording,
        "data": context.data,
        "key": result.key,
        "stamp_ns": result.stamp_ns,
        "method": result.method,
        "frames": result.frames,
        "far_frames": result.far_frames,
        "far_left_out": result.far_left_out,
        "cameras": list(result.depth),
        "prior": {
            name: {
                "source": full.source,
                **asdict(full.fit),
                "share": float(full.from_prior.mean()),
            }
            for name, full in result.full.items()
        },
        "warnings": result.warnings,
        "config": context.config,
        "stages": [
            {
                "name": cost.name,
                "seconds": round(cost.seconds, 3),
                "peak_memory_mb": round(cost.peak_memory_mb, 1),
            }
            for cost in result.costs
        ],
        "versions": versions,
    }


def write_scene(result: Result, context: Context, folder: Path) -> None:
    """Write the folder ``scene/`` if the sweeps are registered."""
    if not result.T_key_lidar:
        return
    place = folder / "scene"
    sweeps = _sweeps(result)
    row_of = {sweep["frame"]: row for row, sweep in enumerate(sweeps)}
    for name, maps in result.depth.items():
        if name in result.images:
            path = map_path(place, "image", name, ".jpg")
            write_file(path, encode_jpeg(result.images[name]))
        for method, baseline in result.baselines.items():
            write_depth_png(map_path(place, method, name), baseline.depth[name].depth_m)
        if name in result.truth_m:
            write_depth_png(map_path(place, "truth", name), result.truth_m[name])
        lookup = np.zeros(max(row_of) + 2, np.uint16)
        lookup[[*row_of]] = 1 + np.arange(len(row_of))
        write_file(map_path(place, "sweep", name), encode_png(lookup[maps.frame]))
        if name in result.rejected:
            write_file(map_path(place, "reason", name), encode_png(result.rejected[name]))
    table = {
        "schema_version": SCHEMA_VERSION,
        "key": result.key,
        "sweeps": sweeps,
        "views": {
            name: {**vars(view.camera), **{n: v for n, v in vars(view).items() if n != "camera"}}
            for name, view in result.views.items()
        },
    }
    write_json(place / "scene.json", table)


def _sweeps(result: Result) -> list[dict[str, Any]]:
    """Return entries of scene.json for all source sweeps and the window, by frame number."""
    frames, rows = np.unique(result.cloud.frame, return_index=True)
    since_s = dict(zip(frames.tolist(), 1e-9 * result.cloud.since_key_ns[rows], strict=True))
    far = {*result.far_frames} - {*result.T_key_lidar}
    return [
        {
            "frame": frame,
            "since_key_s": since_s.get(frame),
            "far": frame in far,
            "T_key_lidar": result.T_key_lidar.get(frame),
        }
        for frame in sorted({*since_s, *result.T_key_lidar})
    ]
