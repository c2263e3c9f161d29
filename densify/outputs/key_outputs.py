# SPDX-License-Identifier: MIT
"""The outputs of a key: depth maps, moving objects, metrics.json, movers.json, run.yaml, scene/.

metrics.json; compare.json has the fields from ``frames`` on, by method, under ``methods``. A score
is null where nothing is known::

    schema_version, key, method
    frames      of the window, absolute numbers
    num_points  of the cloud; num_moving of those
    density     camera -> measured, filled: share of the pixels with a depth; with --prior also
                full, and prior, the share that came from it
    ghosts      `densify.scores.cloud_scores.ghost_scores`
    depth       with truth: camera -> measured, filled (full, prior) -> all, moving, static ->
                `densify.scores.depth_metrics.DepthErrors`
    measure     map -> z, depth along the camera's axis, or range, distance from the lens
    held_out    camera -> as depth: the key densified from its neighbours alone against its own
                returns; curve, `precision_density`; reliability, `densify.depth.confidence`;
                unjudged, share of the filled pixels near which the key sweep has no return
    reliability with truth: map -> the same list against it
    expected_outliers  map -> measured, filled: the share of outliers that confidence expects
    baselines   as from ``frames`` on for each simpler method on the same registration

movers.json, by `ObjectTrack`: schema_version, key, objects (instance as in cloud.laz; size_m:
length, width, height; poses: frame, stamp_ns, num_points, T_key_object (4,4), velocity_m_s (3,) in
key coordinates without the ego-motion, at each sweep that observed it and at the key).

scene/, for pages, viewers and other tools::

    image/CAMERA.jpg   the image that the map shows
    none/CAMERA.png, icp/…, truth/…   depth of the simpler methods and the true one, as in ``depth``
    sweep/CAMERA.png   uint16, measured pixels: 1 + row of the source sweep in ``sweeps``; 0 none
    reason/CAMERA.png  uint8 `Reason` that the nearest point of a pixel was rejected
    scene.json         schema_version, key; sweeps: frame, since_key_s, far, T_key_lidar (4,4);
                       views: map -> camera, T_cam_key (4,4), late_s after the key, image number
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

from densify import __version__
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

SCHEMA_VERSION = 1
"""Version of each JSON file; grows when a field changes its meaning or goes."""
_PACKAGES = (
    *("numpy", "scipy", "torch", "embreex", "kiss-icp", "small-gicp", "opencv-python-headless"),
    *("laspy", "lazrs", "PyYAML"),
)


@dataclass(frozen=True)
class Context:
    """What an output gets beside the result.

    Attributes:
        config: The merged configuration as plain mappings, by section.
        data: The recording, as the user named it.
    """

    config: Mapping[str, Any]
    data: str


def write_depth(result: Result, context: Context, folder: Path) -> None:
    """Write ``depth``, ``depth_filled``, ``confidence`` and ``age``.

    Age is the time between the exposure and the sweep that measured the pixel. A filled pixel has
    the age of the nearest measured pixel.

    Raises:
        ValueError: The maps have no ages.
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
    """Write ``depth_full``, depth completed with the user's prior, and ``confidence_full``.

    The confidence is at most 0.2 where the depth is that of the prior.
    """
    for camera, full in result.full.items():
        write_depth_png(map_path(folder, "depth_full", camera), full.depth_m)
        path = map_path(folder, "confidence_full", camera)
        write_confidence_png(path, full.confidence, full.depth_m)


def write_optical_flow(result: Result, context: Context, folder: Path) -> None:
    """Write ``optical_flow/previous`` and ``optical_flow/next``, if they were asked for."""
    for camera, flows in result.optical_flow.items():
        for other, flow_px in flows.items():
            write_flow_png(map_path(folder / "optical_flow", other, camera), flow_px)


def write_cloud_laz(result: Result, context: Context, folder: Path) -> None:
    """Write ``cloud.laz``."""
    write_cloud(folder / "cloud.laz", result.cloud, result.stamp_ns)


def write_movers(result: Result, context: Context, folder: Path) -> None:
    """Write cloud and depth of each object, if objects are separated.

    They are in ``movers/0007/`` for instance 7, and in ``movers/others/`` for moving points of no
    object.
    """
    for instance, mover in result.movers.items():
        place = folder / "movers" / (f"{instance:04d}" if instance >= 0 else "others")
        for name, maps in mover.depth.items():
            write_depth_png(map_path(place, "depth", name), maps.depth_m)
        write_cloud(place / "cloud.laz", mover.cloud, result.stamp_ns)


def write_metrics(result: Result, context: Context, folder: Path) -> None:
    """Write ``metrics.json``."""
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
    """Write ``movers.json``, if the result has poses."""
    if not result.T_key_lidar:
        return
    names = ("stamp_ns", "num_points", "T_key_object", "velocity_m_s")
    objects = []
    for track in result.tracks:
        poses = [
            {"frame": frame, **{name: getattr(track, name)[i] for name in names}}
            for i, frame in enumerate(track.frames)
        ]
        objects.append({"instance": track.instance, "size_m": track.size_m, "poses": poses})
    table = {"schema_version": SCHEMA_VERSION, "key": result.key, "objects": objects}
    write_json(folder / "movers.json", table)


def write_run_yaml(result: Result, context: Context, folder: Path) -> None:
    """Write ``run.yaml``, `record`."""
    text = yaml.safe_dump(plain(record(result, context)), sort_keys=False, allow_unicode=True)
    write_file(folder / "run.yaml", text.encode())


def record(result: Result, context: Context) -> dict[str, Any]:
    """Return how a result was made.

    The record has data, key, frames, cameras, warnings, configuration, cost of each stage, and
    versions. A package of unknown version, as in system builds, has None.
    """
    versions: dict[str, str | None] = {"densify": __version__, "python": platform.python_version()}
    versions["platform"] = platform.platform()
    for package in _PACKAGES:
        versions[package] = None
        with suppress(PackageNotFoundError):
            versions[package] = version(package)
    return {
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
    """Write ``scene/``, if the result has poses."""
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
    """Return the sweeps of the window and all other sources of the cloud, by frame."""
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
