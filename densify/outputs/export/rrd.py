# SPDX-License-Identifier: MIT
"""A recording of one key or a drive for rerun's viewer (https://rerun.io, ``densify[rerun]``), to a
file or live.

Two time lines, ``time`` (the recording's clock as UNIX time) and ``frame``, have in ``world/key``,
the frame of the key that is shown::

    cloud/standing, cloud/moving  the accumulated cloud, at the key's moment
    cloud/trails                  what moves where registration alone puts it; hidden at first
    sweep, vehicle                each sweep of one key's window as it was measured, and the
                                  scanner; of a drive each key's own
    movers/box, movers/path       moving objects; labels say object and speed
    CAMERA, CAMERA/image, …/depth, …/depth_filled
                                  pinhole, image and metres; of other lenses without a pinhole
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from scipy.spatial.transform import Rotation

from densify.geometry.types import Float, ObjectTrack
from densify.geometry.types.rigid import inverse
from densify.outputs.export.finished_run import FinishedRun
from densify.outputs.export.timeline import Shot, Timeline, timelines
from densify.readers.extras import needed

if TYPE_CHECKING:
    import rerun

_UNSEEN = np.array([140, 140, 140], np.uint8)
_COLOURS = np.array(  # Okabe and Ito's, told apart by colour-blind people too
    [[230, 159, 0], [86, 180, 233], [0, 158, 115], [240, 228, 66], [213, 94, 0], [204, 121, 167]],
    np.uint8,
)
_POINT, _SWEEP_POINT = -1.5, -2.5  # radii in points of the screen, as rerun writes them
_KEY = "world/key"
_FRUSTUM_M = 3.0


def write_export(run: FinishedRun, folder: Path) -> None:
    """One key, see `write_drive`."""
    write_drive([run], folder)


def write_drive(runs: Sequence[FinishedRun], folder: Path) -> None:
    """``recording.rrd``. The same runs give the same data; rerun numbers its chunks by the clock,
    so bytes differ. Raises InputError without rerun, and as `timelines`."""
    rr = needed("rerun", "rerun", "Recordings for rerun")
    with _stream(rr, runs) as stream:
        stream.save(folder / "recording.rrd", default_blueprint=_blueprint(rr, runs))
        for timeline in timelines(runs):
            _log(rr, stream, timeline)


def show(runs: Sequence[FinishedRun], port: int = 9876) -> None:
    """The same in rerun's viewer: the one that listens on the port, else a new one, which stays
    when this process ends. Raises InputError without rerun, and as `timelines`."""
    rr = needed("rerun", "rerun", "Recordings for rerun")
    with _stream(rr, runs) as stream:
        stream.spawn(port=port, default_blueprint=_blueprint(rr, runs))
        for timeline in timelines(runs):
            _log(rr, stream, timeline)
        stream.flush()


def _stream(rr: Any, runs: Sequence[FinishedRun]) -> rerun.RecordingStream:
    keys = "-".join(str(key) for key in sorted({runs[0].key, runs[-1].key}))
    stream = rr.RecordingStream("densify", recording_id=f"key-{keys}", send_properties=False)
    stream.set_log_time_enabled(False)
    stream.set_log_tick_enabled(False)
    return stream


def _blueprint(rr: Any, runs: Sequence[FinishedRun]) -> Any:
    """The scene beside the images, trails hidden."""
    b = rr.blueprint
    hidden = {f"{_KEY}/cloud/trails": b.EntityBehavior(visible=False)}
    scene = b.Spatial3DView(origin="world", name="scene", overrides=hidden)
    names = dict.fromkeys(name for run in runs for name in run.chosen_views)
    views = [b.Spatial2DView(origin=f"{_KEY}/{name}", name=name) for name in names]
    layout = b.Horizontal(scene, b.Vertical(*views), column_shares=[3, 2]) if views else scene
    return b.Blueprint(layout, collapse_panels=True)


def _log(rr: Any, stream: rerun.RecordingStream, timeline: Timeline) -> None:
    def log(name: str, shown: Any) -> None:
        stream.log(f"{_KEY}/{name}".rstrip("/"), shown, strict=True)

    def at(stamp_ns: int, frame: int) -> None:
        stream.set_time("time", timestamp=np.datetime64(stamp_ns, "ns"))
        stream.set_time("frame", sequence=frame)

    def points(xyz: Any, rgb: Any, radius: float) -> Any:
        seen = rgb.any(axis=1, keepdims=True)
        return rr.Points3D(xyz, colors=np.where(seen, rgb, _UNSEEN), radii=radius)

    cloud, moving = timeline.cloud, timeline.cloud.moving
    stream.log("world", rr.ViewCoordinates.FLU, static=True, strict=True)
    at(timeline.sweeps[0].stamp_ns, timeline.sweeps[0].frame)
    log("", _transform(rr, timeline.T_world_key))
    log("cloud/standing", points(cloud.points[~moving], cloud.rgb[~moving], _POINT))
    log("cloud/moving", points(cloud.points[moving], cloud.rgb[moving], _POINT))
    log("cloud/trails", points(cloud.rigid_points[moving], cloud.rgb[moving], _POINT))
    log("movers/path", _paths(rr, timeline.tracks))
    for sweep in timeline.sweeps:
        at(sweep.stamp_ns, sweep.frame)
        log("sweep", points(sweep.points, sweep.rgb, _SWEEP_POINT))
        log("vehicle", _transform(rr, sweep.T_key_lidar))
        log("movers/box", _boxes(rr, timeline.tracks, sweep.frame))
    for shot in timeline.shots:
        at(shot.stamp_ns, timeline.key)
        for name, shown in _shown(rr, shot):
            log(f"{shot.name}/{name}", shown)


def _shown(rr: Any, shot: Shot) -> Iterator[tuple[str, Any]]:
    """What a map shows, by the name below that of the map."""
    camera = shot.view.camera
    yield "", _transform(rr, inverse(shot.view.T_cam_key))
    if shot.is_pinhole:
        yield (
            "",
            rr.Pinhole(
                image_from_camera=camera.K,
                resolution=[camera.width_px, camera.height_px],
                camera_xyz=rr.ViewCoordinates.RDF,
                image_plane_distance=_FRUSTUM_M,
            ),
        )
    if shot.jpeg is not None:
        yield "image", rr.EncodedImage(contents=shot.jpeg, media_type="image/jpeg")
    yield "depth", rr.DepthImage(shot.depth_m, meter=1.0, colormap="viridis")
    yield "depth_filled", rr.DepthImage(shot.filled_m, meter=1.0, colormap="viridis")


def _paths(rr: Any, tracks: Sequence[ObjectTrack]) -> Any:
    return rr.LineStrips3D(
        [track.T_key_object[:, :3, 3] for track in tracks],
        colors=[_colour(track.instance) for track in tracks],
    )


def _boxes(rr: Any, tracks: Sequence[ObjectTrack], frame: int) -> Any:
    seen = [(t, t.frames.index(frame)) for t in tracks if frame in t.frames]
    turns = [Rotation.from_matrix(t.T_key_object[i, :3, :3]).as_quat() for t, i in seen]
    speeds = [float(np.linalg.norm(t.velocity_m_s[i])) for t, i in seen]
    return rr.Boxes3D(
        centers=[t.T_key_object[i, :3, 3] for t, i in seen],
        half_sizes=[t.size_m / 2 for t, _ in seen],
        quaternions=turns,
        colors=[_colour(t.instance) for t, _ in seen],
        labels=[f"{t.instance}: {v:.1f} m/s" for (t, _), v in zip(seen, speeds, strict=True)],
    )


def _transform(rr: Any, T: Float) -> Any:
    return rr.Transform3D(translation=T[:3, 3], mat3x3=T[:3, :3])


def _colour(instance: int) -> Any:
    return _COLOURS[instance % len(_COLOURS)]
