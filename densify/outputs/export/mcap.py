# SPDX-License-Identifier: MIT
"""A recording of one key or a drive as MCAP in Foxglove's schemas (``densify[mcap]``), for
Foxglove, Lichtblick and whatever else reads them.

Topics::

    /tf                            FrameTransform: world -> key, key -> vehicle and each camera
    /cloud                         PointCloud: the accumulated cloud, at the key's moment
    /sweep                         PointCloud: each sweep of one key's window as it was measured;
                                   of a drive each key's own
    /movers, /paths                SceneUpdate: boxes by time, and the way of each
    /CAMERA/image, /CAMERA/calibration, /CAMERA/depth, /CAMERA/depth_filled
                                   CompressedImage, CameraCalibration, RawImage (32FC1, metres)
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from densify.geometry.types import Camera, Float, ObjectTrack
from densify.geometry.types.rigid import inverse
from densify.outputs.export.finished_run import FinishedRun
from densify.outputs.export.timeline import Shot, Timeline, timelines
from densify.readers.extras import needed

_UNSEEN = np.array([140, 140, 140], np.uint8)
_PATH = {"r": 0.84, "g": 0.37, "b": 0.0, "a": 1.0}
_BOX = {**_PATH, "a": 0.4}
_LINE_M = 0.1
_NS = 10**9
_LENSES = {4: "plumb_bob", 5: "plumb_bob", 8: "rational_polynomial"}
"""Number of OpenCV's coefficients -> what ROS calls the lens."""


def write_export(run: FinishedRun, folder: Path) -> None:
    """One key, see `write_drive`."""
    write_drive([run], folder)


def write_drive(runs: Sequence[FinishedRun], folder: Path) -> None:
    """``recording.mcap``. Same runs, same bytes. Raises InputError without foxglove-sdk, and as
    `timelines`."""
    foxglove = needed("foxglove", "mcap", "MCAP files")
    context, channels = foxglove.Context(), {}
    options = foxglove.mcap.MCAPWriteOptions(compression_threads=0)
    with foxglove.open_mcap(folder / "recording.mcap", context=context, writer_options=options):
        for timeline in timelines(runs):
            for topic, stamp_ns, message in _messages(foxglove.messages, timeline):
                if topic not in channels:
                    kind = getattr(foxglove.channels, f"{type(message).__name__}Channel")
                    channels[topic] = kind(topic, context=context)
                channels[topic].log(message, log_time=stamp_ns)


def _messages(m: Any, timeline: Timeline) -> Iterator[tuple[str, int, Any]]:
    """Topic, time and message. m: `foxglove.messages`."""
    start_ns = timeline.sweeps[0].stamp_ns
    yield "/tf", start_ns, _transform(m, start_ns, "world", "key", timeline.T_world_key)
    cloud = timeline.cloud
    beside = {name: getattr(cloud, name) for name in ("confidence", "instance", "frame")}
    yield "/cloud", start_ns, _cloud(m, start_ns, cloud.points, cloud.rgb, beside)
    yield "/paths", start_ns, _paths(m, start_ns, timeline.tracks)
    for sweep in timeline.sweeps:
        now_ns = sweep.stamp_ns
        yield "/tf", now_ns, _transform(m, now_ns, "key", "vehicle", sweep.T_key_lidar)
        moving = {"moving": sweep.moving.astype(np.uint8)}
        yield "/sweep", now_ns, _cloud(m, now_ns, sweep.points, sweep.rgb, moving)
        yield "/movers", now_ns, _boxes(m, now_ns, timeline.tracks, sweep.frame)
    for shot in timeline.shots:
        now_ns, T_key_cam = shot.stamp_ns, inverse(shot.view.T_cam_key)
        yield "/tf", start_ns, _transform(m, start_ns, "key", shot.name, T_key_cam)
        for kind, message in _of_camera(m, shot):
            yield f"/{shot.name}/{kind}", now_ns, message


def _of_camera(m: Any, shot: Shot) -> Iterator[tuple[str, Any]]:
    camera, stamp = shot.view.camera, _stamp(m, shot.stamp_ns)
    about = {"timestamp": stamp, "frame_id": shot.name}
    if shot.jpeg is not None:
        yield "image", m.CompressedImage(**about, data=shot.jpeg, format="jpeg")
    lens = _lens(camera)
    if lens is not None:
        size = {"width": camera.width_px, "height": camera.height_px}
        K, P = camera.K, np.hstack([camera.K, np.zeros((3, 1))])
        numbers = {"K": K, "R": np.eye(3), "P": P}
        flat = {name: matrix.ravel().tolist() for name, matrix in numbers.items()}
        yield (
            "calibration",
            m.CameraCalibration(**about, **size, distortion_model=lens[0], D=lens[1], **flat),
        )
    for kind, depth_m in (("depth", shot.depth_m), ("depth_filled", shot.filled_m)):
        height, width = depth_m.shape
        data = np.ascontiguousarray(depth_m, "<f4").tobytes()
        size = {"width": width, "height": height, "step": 4 * width}
        yield kind, m.RawImage(**about, **size, encoding="32FC1", data=data)


def _lens(camera: Camera) -> tuple[str, list[float]] | None:
    """Its name and coefficients; None for one that has no name there."""
    coefficients = [*camera.distortion]
    if camera.is_rectified:
        return "plumb_bob", [0.0] * 5
    if camera.model == "fisheye":
        return "kannala_brandt", coefficients
    if camera.model == "pinhole" and len(coefficients) in _LENSES:
        num = 5 if len(coefficients) == 4 else len(coefficients)
        return _LENSES[len(coefficients)], (coefficients + [0.0])[:num]
    return None


def _cloud(m: Any, stamp_ns: int, points: Any, rgb: Any, beside: dict[str, NDArray[Any]]) -> Any:
    """beside: more columns, of float32, int32 or uint8."""
    seen = rgb.any(axis=1, keepdims=True)
    colours = np.where(seen, rgb, _UNSEEN)
    columns = dict(zip("xyz", points.T.astype("<f4"), strict=True))
    columns |= dict(zip(("red", "green", "blue"), colours.T, strict=True))
    columns |= {"alpha": np.full(len(points), 255, np.uint8), **beside}
    table = np.empty(len(points), [(name, values.dtype) for name, values in columns.items()])
    for name, values in columns.items():
        table[name] = values
    types = m.PackedElementFieldNumericType
    kinds = {"f4": types.Float32, "i4": types.Int32, "u1": types.Uint8}
    return m.PointCloud(
        timestamp=_stamp(m, stamp_ns),
        frame_id="key",
        pose=_pose(m, np.eye(4)),
        point_stride=table.dtype.itemsize,
        fields=[
            m.PackedElementField(name=name, offset=offset, type=kinds[kind.str[1:]])
            for name, (kind, offset, *_) in (table.dtype.fields or {}).items()
        ],
        data=table.tobytes(),
    )


def _boxes(m: Any, stamp_ns: int, tracks: Sequence[ObjectTrack], frame: int) -> Any:
    """The boxes of that sweep in place of all before."""
    entities = []
    for track in tracks:
        if frame not in track.frames:
            continue
        i = track.frames.index(frame)
        speed = float(np.linalg.norm(track.velocity_m_s[i]))
        T, (x, y, z) = track.T_key_object[i], track.size_m.tolist()
        cube = m.CubePrimitive(
            pose=_pose(m, T), size=m.Vector3(x=x, y=y, z=z), color=m.Color(**_BOX)
        )
        entities.append(
            m.SceneEntity(
                timestamp=_stamp(m, stamp_ns),
                frame_id="key",
                id=f"object {track.instance}",
                cubes=[cube],
                metadata=[m.KeyValuePair(key="speed", value=f"{speed:.2f} m/s")],
            )
        )
    everything = m.SceneEntityDeletion(
        timestamp=_stamp(m, stamp_ns), type=m.SceneEntityDeletionType.All
    )
    return m.SceneUpdate(deletions=[everything], entities=entities)


def _paths(m: Any, stamp_ns: int, tracks: Sequence[ObjectTrack]) -> Any:
    lines = [
        m.LinePrimitive(
            type=m.LinePrimitiveLineType.LineStrip,
            pose=_pose(m, np.eye(4)),
            thickness=_LINE_M,
            points=[m.Point3(x=x, y=y, z=z) for x, y, z in track.T_key_object[:, :3, 3].tolist()],
            color=m.Color(**_PATH),
        )
        for track in tracks
    ]
    entity = m.SceneEntity(timestamp=_stamp(m, stamp_ns), frame_id="key", id="paths", lines=lines)
    return m.SceneUpdate(entities=[entity])


def _transform(m: Any, stamp_ns: int, parent: str, child: str, T: Float) -> Any:
    """T: from child to parent."""
    x, y, z = T[:3, 3].tolist()
    return m.FrameTransform(
        timestamp=_stamp(m, stamp_ns),
        parent_frame_id=parent,
        child_frame_id=child,
        translation=m.Vector3(x=x, y=y, z=z),
        rotation=_quaternion(m, T),
    )


def _pose(m: Any, T: Float) -> Any:
    x, y, z = T[:3, 3].tolist()
    return m.Pose(position=m.Vector3(x=x, y=y, z=z), orientation=_quaternion(m, T))


def _quaternion(m: Any, T: Float) -> Any:
    x, y, z, w = Rotation.from_matrix(T[:3, :3]).as_quat().tolist()
    return m.Quaternion(x=x, y=y, z=z, w=w)


def _stamp(m: Any, stamp_ns: int) -> Any:
    return m.Timestamp(sec=stamp_ns // _NS, nsec=stamp_ns % _NS)
