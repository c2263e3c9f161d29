# SPDX-License-Identifier: MIT
"""Write one key sweep or a drive as MCAP in Foxglove's schemas, for Foxglove and Lichtblick.

Topics, with "key" for the key sweep's lidar frame::

    /tf                FrameTransform: world -> key, key -> vehicle and each camera
    /cloud, /sweep     PointCloud: accumulated cloud at the key sweep's time; sweeps as measured
    /movers            SceneUpdate: boxes of moving objects, by time
    /CAMERA/image, /CAMERA/calibration, /CAMERA/depth, /CAMERA/depth_filled (32FC1, metres)
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from densify.config.file_content import needed
from densify.geometry import poses
from densify.geometry.arrays import table
from densify.geometry.types import Camera, Float, ObjectTrack
from densify.outputs.export.finished_run import FinishedRun, Shot, Timeline, colours, timelines

_BOX = {"r": 0.84, "g": 0.37, "b": 0.0, "a": 0.4}
_NS = 10**9


def write_mcap(runs: Sequence[FinishedRun], folder: Path) -> None:
    """Write ``recording.mcap``. Equal runs give equal bytes."""
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
    """Yield topic, time in ns and message. ``m`` is the module `foxglove.messages`."""
    start_ns, cloud = timeline.sweeps[0].stamp_ns, timeline.cloud
    yield "/tf", start_ns, _transform(m, start_ns, "world", "key", timeline.T_world_key)
    beside = {name: getattr(cloud, name) for name in ("confidence", "instance", "frame")}
    yield "/cloud", start_ns, _cloud(m, start_ns, cloud.points, colours(cloud), beside)
    for sweep in timeline.sweeps:
        now_ns = sweep.stamp_ns
        yield "/tf", now_ns, _transform(m, now_ns, "key", "vehicle", sweep.T_key_lidar)
        own, moving = sweep.points, {"moving": sweep.points.moving.astype(np.uint8)}
        yield "/sweep", now_ns, _cloud(m, now_ns, own.rigid_points, colours(own), moving)
        yield "/movers", now_ns, _boxes(m, now_ns, timeline.run.tracks, sweep.frame)
    for shot in timeline.shots:
        T_key_cam = poses.inverse(shot.view.T_cam_key)
        yield "/tf", start_ns, _transform(m, start_ns, "key", shot.name, T_key_cam)
        for kind, message in _of_shot(m, shot):
            yield f"/{shot.name}/{kind}", shot.stamp_ns, message


def _of_shot(m: Any, shot: Shot) -> Iterator[tuple[str, Any]]:
    about = {"timestamp": _stamp(m, shot.stamp_ns), "frame_id": shot.name}
    if shot.jpeg is not None:
        yield "image", m.CompressedImage(**about, data=shot.jpeg, format="jpeg")
    camera = shot.view.camera
    size = {"width": camera.width_px, "height": camera.height_px}
    if (lens := _lens(camera)) is not None:
        matrices = {"K": camera.K, "R": np.eye(3), "P": np.hstack([camera.K, np.zeros((3, 1))])}
        flat = {name: matrix.ravel().tolist() for name, matrix in matrices.items()}
        named = {"distortion_model": lens[0], "D": lens[1]}
        yield "calibration", m.CameraCalibration(**about, **size, **named, **flat)
    for kind, depth_m in shot.maps_m.items():
        image = {"encoding": "32FC1", "step": 4 * camera.width_px, "data": depth_m.tobytes()}
        yield kind, m.RawImage(**about, **size, **image)


def _lens(camera: Camera) -> tuple[str, list[float]] | None:
    """Return ROS's name of the lens model and its coefficients, None if ROS has no such model."""
    lens = [*camera.distortion]
    if camera.model == "fisheye":
        return "kannala_brandt", lens
    if camera.model != "pinhole" or len(lens) not in (0, 4, 5, 8):
        return None
    if len(lens) == 8:
        return "rational_polynomial", lens
    return "plumb_bob", (lens + [0.0] * 5)[:5]


def _cloud(m: Any, stamp_ns: int, points: Any, rgb: Any, beside: dict[str, NDArray[Any]]) -> Any:
    values = [*points.T.astype(np.float32), *rgb.T]
    columns = dict(zip(("x", "y", "z", "red", "green", "blue"), values, strict=True))
    rows = table(columns | {"alpha": np.full(len(points), 255, np.uint8), **beside})
    types = m.PackedElementFieldNumericType
    kinds = {"f4": types.Float32, "i4": types.Int32, "u1": types.Uint8}
    fields = [
        m.PackedElementField(name=name, offset=offset, type=kinds[kind.str[1:]])
        for name, (kind, offset, *_) in (rows.dtype.fields or {}).items()
    ]
    about = {"timestamp": _stamp(m, stamp_ns), "frame_id": "key", "pose": _pose(m, np.eye(4))}
    layout = {"point_stride": rows.dtype.itemsize, "fields": fields}
    return m.PointCloud(**about, **layout, data=rows.tobytes())


def _boxes(m: Any, stamp_ns: int, tracks: Sequence[ObjectTrack], frame: int) -> Any:
    """Return the boxes of objects at sweep ``frame``. The message replaces all earlier boxes."""
    stamp, entities = _stamp(m, stamp_ns), []
    for track, i in [(t, t.frames.index(frame)) for t in tracks if frame in t.frames]:
        pose, size = _pose(m, track.T_key_object[i]), _vector(m, track.size_m)
        cube = m.CubePrimitive(pose=pose, size=size, color=m.Color(**_BOX))
        speed = f"{np.linalg.norm(track.velocity_m_s[i]):.2f} m/s"
        about = {"id": f"object {track.instance}", "frame_id": "key", "timestamp": stamp}
        metadata = [m.KeyValuePair(key="speed", value=speed)]
        entities.append(m.SceneEntity(**about, cubes=[cube], metadata=metadata))
    everything = m.SceneEntityDeletion(timestamp=stamp, type=m.SceneEntityDeletionType.All)
    return m.SceneUpdate(deletions=[everything], entities=entities)


def _transform(m: Any, stamp_ns: int, parent: str, child: str, T: Float) -> Any:
    """Return the transform of a (4,4) pose T from child to parent."""
    frames = {"parent_frame_id": parent, "child_frame_id": child}
    placed = {"translation": _vector(m, T[:3, 3]), "rotation": _quaternion(m, T)}
    return m.FrameTransform(timestamp=_stamp(m, stamp_ns), **frames, **placed)


def _pose(m: Any, T: Float) -> Any:
    return m.Pose(position=_vector(m, T[:3, 3]), orientation=_quaternion(m, T))


def _quaternion(m: Any, T: Float) -> Any:
    x, y, z, w = Rotation.from_matrix(T[:3, :3]).as_quat().tolist()
    return m.Quaternion(x=x, y=y, z=z, w=w)


def _vector(m: Any, xyz: Float) -> Any:
    return m.Vector3(**dict(zip("xyz", xyz.tolist(), strict=True)))


def _stamp(m: Any, stamp_ns: int) -> Any:
    return m.Timestamp(sec=stamp_ns // _NS, nsec=stamp_ns % _NS)
