# SPDX-License-Identifier: MIT
"""Write one key sweep or a drive for rerun's viewer (https://rerun.io).

Time lines: ``time`` (UNIX, the recording's clock), ``frame``. In ``world/key``, its lidar frame::

    cloud/static, cloud/moving, sweep, vehicle    the cloud, each sweep as measured, lidar poses
    movers/box, movers/path     moving objects; labels give object number and speed
    CAMERA/{image,depth,depth_filled}    image and metres; with a pinhole for rectified cameras
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from densify.config.file_content import needed
from densify.geometry import poses
from densify.geometry.types import Float, ObjectTrack
from densify.outputs.cloud_laz import StoredCloud
from densify.outputs.export.finished_run import FinishedRun, Shot, Timeline, colours, timelines

_KEY = "world/key"
_POINT, _SWEEP_POINT = -1.5, -2.5  # radii in points of the screen, as rerun writes them


def write_rrd(runs: Sequence[FinishedRun], folder: Path) -> None:
    """Write ``recording.rrd``. Bytes differ each time: rerun numbers its chunks by the clock."""
    with _stream(runs) as stream:
        stream.save(folder / "recording.rrd")
        _log(stream, runs)


def show(runs: Sequence[FinishedRun]) -> None:
    """Show the runs in rerun's viewer, which stays open. Raise InputError as `write_rrd`."""
    with _stream(runs) as stream:
        stream.spawn()
        _log(stream, runs)
        stream.flush()


def _stream(runs: Sequence[FinishedRun]) -> Any:
    rr = needed("rerun", "rerun", "Recordings for rerun")
    name = f"key-{runs[0].key}-{runs[-1].key}"
    stream = rr.RecordingStream("densify", recording_id=name, send_properties=False)
    stream.set_log_time_enabled(False)
    stream.set_log_tick_enabled(False)
    return stream


def _log(stream: Any, runs: Sequence[FinishedRun]) -> None:
    import rerun as rr

    stream.log("world", rr.ViewCoordinates.FLU, static=True, strict=True)
    entities = (entity for timeline in timelines(runs) for entity in _entities(timeline))
    for frame, stamp_ns, name, shown in entities:
        stream.set_time("time", timestamp=np.datetime64(stamp_ns, "ns"))
        stream.set_time("frame", sequence=frame)
        stream.log(f"{_KEY}/{name}".rstrip("/"), shown, strict=True)


def _entities(timeline: Timeline) -> Iterator[tuple[int, int, str, Any]]:
    """Yield frame number, stamp in ns, entity path below ``world/key``, and rerun object."""
    import rerun as rr

    def points(xyz: Any, cloud: StoredCloud, radius: float = _POINT) -> Any:
        return rr.Points3D(xyz, colors=colours(cloud), radii=radius)

    moving = timeline.cloud.select(timeline.cloud.moving)
    static = timeline.cloud.select(~timeline.cloud.moving)
    start, tracks = timeline.sweeps[0][:2], timeline.run.tracks
    yield *start, "", _transform(timeline.T_world_key)
    yield *start, "cloud/static", points(static.points, static)
    yield *start, "cloud/moving", points(moving.points, moving)
    paths = [track.T_key_object[:, :3, 3] for track in tracks]
    yield *start, "movers/path", rr.LineStrips3D(paths)
    for sweep in timeline.sweeps:
        now = sweep[:2]
        yield *now, "sweep", points(sweep.points.rigid_points, sweep.points, _SWEEP_POINT)
        yield *now, "vehicle", _transform(sweep.T_key_lidar)
        yield *now, "movers/box", _boxes(tracks, sweep.frame)
    for shot in timeline.shots:
        for name, shown in _of_shot(shot):
            yield timeline.run.key, shot.stamp_ns, f"{shot.name}/{name}", shown


def _of_shot(shot: Shot) -> Iterator[tuple[str, Any]]:
    """Yield (entity path below the camera, rerun object) for pose, lens, image and depth."""
    import rerun as rr

    yield "", _transform(poses.inverse(shot.view.T_cam_key))
    if shot.is_pinhole:
        camera, axes = shot.view.camera, rr.ViewCoordinates.RDF
        size_px = [camera.width_px, camera.height_px]
        yield "", rr.Pinhole(image_from_camera=camera.K, resolution=size_px, camera_xyz=axes)
    if shot.jpeg is not None:
        yield "image", rr.EncodedImage(contents=shot.jpeg, media_type="image/jpeg")
    for name, depth_m in shot.maps_m.items():
        yield name, rr.DepthImage(depth_m, meter=1.0, colormap="viridis")


def _boxes(tracks: Sequence[ObjectTrack], frame: int) -> Any:
    import rerun as rr

    seen = [(t, t.frames.index(frame)) for t in tracks if frame in t.frames]
    speeds = [np.linalg.norm(t.velocity_m_s[i]) for t, i in seen]
    return rr.Boxes3D(
        centers=[t.T_key_object[i, :3, 3] for t, i in seen],
        half_sizes=[t.size_m / 2 for t, _ in seen],
        quaternions=[Rotation.from_matrix(t.T_key_object[i, :3, :3]).as_quat() for t, i in seen],
        labels=[f"{t.instance}: {v:.1f} m/s" for (t, _), v in zip(seen, speeds, strict=True)],
    )


def _transform(T: Float) -> Any:
    import rerun as rr

    return rr.Transform3D(translation=T[:3, 3], mat3x3=T[:3, :3])
