# SPDX-License-Identifier: MIT
"""Show a key or a drive, as docs/formats/writing.md lists: Foxglove, rerun, open3d, a video."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from densify.config.errors import InputError, OutputError
from densify.config.file_content import import_extra
from densify.geometry import poses
from densify.geometry.arrays import table
from densify.geometry.types import Camera, CameraView, Float, Float32, ObjectTrack
from densify.outputs.cloud_files import StoredCloud
from densify.outputs.depth_png import Picture, metres
from densify.outputs.finished_run import FinishedRun, key_poses
from densify.outputs.plots import colour_depth
from densify.readers.decoded_files import decode_image

_NS = 10**9
_BOX_COLOUR = {"r": 0.84, "g": 0.37, "b": 0.0, "a": 0.4}
_ROS_LENSES = {8: "rational_polynomial", 5: "plumb_bob", 4: "plumb_bob", 0: "plumb_bob"}
_KEY = "world/key"
_FRAMES_PER_S = 10.0
_BAR_PX = 6  # height of the bar that shows how far the video is
_MOST_WIDTH_PX = 1280
_POINT, _SWEEP_POINT = -1.5, -2.5  # radii in points of the screen, as rerun writes them


class ShownBox(NamedTuple):
    """The box of a moving object at one time."""

    instance: int  # number of the object
    T_key_object: Float  # (4,4) pose in the key sweep's lidar frame
    size_m: Float  # (3,) length, width and height
    speed_m_s: float


class ShownSweep(NamedTuple):
    """A sweep as measured, for display, with its registered pose."""

    frame: int  # frame number
    stamp_ns: int  # reference time in ns since 1970
    T_key_lidar: Float  # (4,4) pose in the key sweep's lidar frame
    points: StoredCloud  # points of the sweep. ``points.rigid_points`` are the measured positions.
    boxes: list[ShownBox]  # boxes of the moving objects at the sweep's time


class Shot(NamedTuple):
    """An image of a camera (name and exposure time), with its depth maps."""

    name: str  # name of the map
    view: CameraView  # camera and pose
    stamp_ns: int  # time of the exposure in ns since 1970
    jpeg: bytes | None  # bytes of the image file, None without an image
    maps_m: dict[str, Float32]  # "depth" and "depth_filled" -> (H,W) float32 metres, 0 for no depth
    is_pinhole: bool  # True if the camera has no distortion and depth is along its axis


class Timeline(NamedTuple):
    """All that a viewer shows of one densified key sweep: cloud, sweeps and camera images."""

    key: int  # frame number of the key sweep
    T_world_key: Float  # (4,4) pose. The world is the first key sweep's lidar frame.
    cloud: StoredCloud  # accumulated points at the key sweep's time, key sweep's lidar frame
    # Sweeps of the window, ascending in time; of several runs, the key sweeps alone
    sweeps: list[ShownSweep]
    shots: list[Shot]  # one for each chosen map
    tracks: list[ObjectTrack]  # moving objects


def timelines(runs: Sequence[FinishedRun]) -> Iterator[Timeline]:
    """Yield the content for viewers: all sweeps of a single run, the key sweeps of several runs."""
    for T_world_key, run in zip(key_poses(runs), runs, strict=True):
        cloud, sweeps = run.cloud(), []
        for sweep in run.scene.table["sweeps"]:
            frame, since_s, T = sweep["frame"], sweep["since_key_s"], sweep["T_key_lidar"]
            if frame == run.key or (len(runs) == 1 and None not in (since_s, T)):
                stamp_ns = run.stamp_ns + round(_NS * (since_s or 0.0))
                points, boxes = cloud.sweep(frame), _boxes_at(run.tracks, frame)
                sweeps.append(ShownSweep(frame, stamp_ns, np.array(T), points, boxes))
        shots = [_shot(run, name) for name in run.scene.views if name in run.chosen_maps]
        yield Timeline(run.key, T_world_key, cloud, sweeps, shots, run.tracks)


def _boxes_at(tracks: Sequence[ObjectTrack], frame: int) -> list[ShownBox]:
    """Return the boxes of the objects at the time of a sweep."""
    boxes = []
    for track in tracks:
        if frame in track.frames:
            row = track.frames.index(frame)
            speed_m_s = float(np.linalg.norm(track.velocity_m_s[row]))
            boxes.append(ShownBox(track.instance, track.T_key_object[row], track.size_m, speed_m_s))
    return boxes


def _shot(run: FinishedRun, name: str) -> Shot:
    """Return the image of a map with its depth."""
    view, maps = run.scene.views[name], run.maps(name)
    stamp_ns = run.stamp_ns + round(_NS * view.late_s)
    maps_m = {kind: metres(maps[kind]) for kind in ("depth", "depth_filled")}
    is_pinhole = view.camera.is_rectified and run.measure(name) == "z"
    return Shot(name, view, stamp_ns, run.jpeg(name), maps_m, is_pinhole)


def _split_moving(cloud: StoredCloud) -> dict[str, StoredCloud]:
    """Return the static and the moving points of a cloud, by the name that viewers show."""
    return {"static": cloud.select(~cloud.moving), "moving": cloud.select(cloud.moving)}


def write_mcap(runs: Sequence[FinishedRun], folder: Path) -> None:
    """Write ``recording.mcap``. Equal runs give equal bytes."""
    foxglove = import_extra("foxglove", "mcap", "MCAP files")
    context, channels = foxglove.Context(), {}
    options = foxglove.mcap.MCAPWriteOptions(compression_threads=0)
    messages = _FoxgloveMessages(foxglove.messages)
    with foxglove.open_mcap(folder / "recording.mcap", context=context, writer_options=options):
        for timeline in timelines(runs):
            for topic, stamp_ns, message in messages.of_timeline(timeline):
                if topic not in channels:
                    kind = getattr(foxglove.channels, f"{type(message).__name__}Channel")
                    channels[topic] = kind(topic, context=context)
                channels[topic].log(message, log_time=stamp_ns)


class _FoxgloveMessages:
    """Make messages in Foxglove's schemas."""

    def __init__(self, schemas: Any) -> None:
        self._schemas = schemas  # the module `foxglove.messages`

    def of_timeline(self, timeline: Timeline) -> Iterator[tuple[str, int, Any]]:
        """Yield topic, time in ns and message."""
        start_ns, cloud = timeline.sweeps[0].stamp_ns, timeline.cloud
        yield "/tf", start_ns, self._transform(start_ns, "world", "key", timeline.T_world_key)
        columns = {name: getattr(cloud, name) for name in ("confidence", "instance", "frame")}
        yield "/cloud", start_ns, self._cloud(start_ns, cloud.points, cloud.shown_rgb, columns)
        for sweep in timeline.sweeps:
            now_ns, points = sweep.stamp_ns, sweep.points
            yield "/tf", now_ns, self._transform(now_ns, "key", "vehicle", sweep.T_key_lidar)
            columns = {"moving": points.moving.astype(np.uint8)}
            cloud_now = self._cloud(now_ns, points.rigid_points, points.shown_rgb, columns)
            yield "/sweep", now_ns, cloud_now
            yield "/movers", now_ns, self._boxes(now_ns, sweep.boxes)
        for shot in timeline.shots:
            T_key_cam = poses.inverse(shot.view.T_cam_key)
            yield "/tf", start_ns, self._transform(start_ns, "key", shot.name, T_key_cam)
            for kind, message in self._of_shot(shot):
                yield f"/{shot.name}/{kind}", shot.stamp_ns, message

    def _of_shot(self, shot: Shot) -> Iterator[tuple[str, Any]]:
        """Yield the last part of the topic and the message."""
        header = {"timestamp": self._stamp(shot.stamp_ns), "frame_id": shot.name}
        if shot.jpeg is not None:
            yield "image", self._schemas.CompressedImage(**header, data=shot.jpeg, format="jpeg")
        camera = shot.view.camera
        header |= {"width": camera.width_px, "height": camera.height_px}
        if lens := _ros_lens(camera):
            P = np.hstack([camera.K, np.zeros((3, 1))])
            matrices = {"K": camera.K, "R": np.eye(3), "P": P}
            rows = {name: matrix.ravel().tolist() for name, matrix in matrices.items()}
            yield "calibration", self._schemas.CameraCalibration(**header, **lens, **rows)
        for kind, depth_m in shot.maps_m.items():
            pixels = {"encoding": "32FC1", "step": 4 * camera.width_px, "data": depth_m.tobytes()}
            yield kind, self._schemas.RawImage(**header, **pixels)

    def _cloud(
        self, stamp_ns: int, xyz: Float, rgb: NDArray[np.uint8], columns: dict[str, NDArray[Any]]
    ) -> Any:
        """Return the message of points with colours and further columns."""
        values = [*xyz.T.astype(np.float32), *rgb.T, np.full(len(xyz), 255, np.uint8)]
        names = ("x", "y", "z", "red", "green", "blue", "alpha")
        rows = table(dict(zip(names, values, strict=True)) | columns)
        types = self._schemas.PackedElementFieldNumericType
        kinds = {"f4": types.Float32, "i4": types.Int32, "u1": types.Uint8}
        fields = [
            self._schemas.PackedElementField(name=name, offset=offset, type=kinds[kind.str[1:]])
            for name, (kind, offset, *_) in (rows.dtype.fields or {}).items()
        ]
        return self._schemas.PointCloud(
            timestamp=self._stamp(stamp_ns),
            frame_id="key",
            pose=self._pose(np.eye(4)),
            point_stride=rows.dtype.itemsize,
            fields=fields,
            data=rows.tobytes(),
        )

    def _boxes(self, stamp_ns: int, boxes: Sequence[ShownBox]) -> Any:
        """Return the message of all boxes at a time, which replaces earlier boxes."""
        schemas, stamp, entities = self._schemas, self._stamp(stamp_ns), []
        for box in boxes:
            cube = schemas.CubePrimitive(
                pose=self._pose(box.T_key_object),
                size=self._vector(box.size_m),
                color=schemas.Color(**_BOX_COLOUR),
            )
            speed = schemas.KeyValuePair(key="speed", value=f"{box.speed_m_s:.2f} m/s")
            header = {"id": f"object {box.instance}", "frame_id": "key", "timestamp": stamp}
            entities.append(schemas.SceneEntity(**header, cubes=[cube], metadata=[speed]))
        every = schemas.SceneEntityDeletionType.All
        deletion = schemas.SceneEntityDeletion(timestamp=stamp, type=every)
        return schemas.SceneUpdate(deletions=[deletion], entities=entities)

    def _transform(self, stamp_ns: int, parent: str, child: str, T_parent_child: Float) -> Any:
        """Return the message of a (4,4) pose."""
        return self._schemas.FrameTransform(
            timestamp=self._stamp(stamp_ns),
            parent_frame_id=parent,
            child_frame_id=child,
            translation=self._vector(T_parent_child[:3, 3]),
            rotation=self._quaternion(T_parent_child),
        )

    def _pose(self, T: Float) -> Any:
        position, orientation = self._vector(T[:3, 3]), self._quaternion(T)
        return self._schemas.Pose(position=position, orientation=orientation)

    def _quaternion(self, T: Float) -> Any:
        x, y, z, w = Rotation.from_matrix(T[:3, :3]).as_quat().tolist()
        return self._schemas.Quaternion(x=x, y=y, z=z, w=w)

    def _vector(self, xyz: Float) -> Any:
        return self._schemas.Vector3(**dict(zip("xyz", xyz.tolist(), strict=True)))

    def _stamp(self, stamp_ns: int) -> Any:
        return self._schemas.Timestamp(sec=stamp_ns // _NS, nsec=stamp_ns % _NS)


def _ros_lens(camera: Camera) -> dict[str, Any]:
    """Return ROS's name of the lens model and its coefficients, {} if ROS has no such model."""
    lens = [*camera.distortion]
    if camera.model == "fisheye":
        return {"distortion_model": "kannala_brandt", "D": lens}
    if camera.model != "pinhole" or len(lens) not in _ROS_LENSES:
        return {}
    return {"distortion_model": _ROS_LENSES[len(lens)], "D": lens + [0.0] * (5 - len(lens))}


def write_rrd(runs: Sequence[FinishedRun], folder: Path) -> None:
    """Write ``recording.rrd``, whose bytes always differ: rerun numbers chunks by the clock."""
    with _rerun_stream(runs) as stream:
        stream.save(folder / "recording.rrd")
        _log_to_rerun(stream, runs)


def show_in_rerun(runs: Sequence[FinishedRun]) -> None:
    """Show the runs in rerun's viewer, which stays open. Raise InputError without rerun."""
    with _rerun_stream(runs) as stream:
        stream.spawn()
        _log_to_rerun(stream, runs)
        stream.flush()


def _rerun_stream(runs: Sequence[FinishedRun]) -> Any:
    """Return a new recording of rerun."""
    rr = import_extra("rerun", "rerun", "Recordings for rerun")
    name = f"key-{runs[0].key}-{runs[-1].key}"
    stream = rr.RecordingStream("densify", recording_id=name, send_properties=False)
    stream.set_log_time_enabled(False)
    stream.set_log_tick_enabled(False)
    return stream


def _log_to_rerun(stream: Any, runs: Sequence[FinishedRun]) -> None:
    """Log all entities of the runs."""
    import rerun as rr

    stream.log("world", rr.ViewCoordinates.FLU, static=True, strict=True)
    for timeline in timelines(runs):
        for frame, stamp_ns, name, shown in _rerun_entities(timeline):
            stream.set_time("time", timestamp=np.datetime64(stamp_ns, "ns"))
            stream.set_time("frame", sequence=frame)
            stream.log(f"{_KEY}/{name}".rstrip("/"), shown, strict=True)


def _rerun_entities(timeline: Timeline) -> Iterator[tuple[int, int, str, Any]]:
    """Yield frame number, stamp in ns, entity path below ``world/key``, and rerun object."""
    import rerun as rr

    def points(xyz: Float, cloud: StoredCloud, radius: float) -> Any:
        return rr.Points3D(xyz, colors=cloud.shown_rgb, radii=radius)

    cloud, start = timeline.cloud, (timeline.sweeps[0].frame, timeline.sweeps[0].stamp_ns)
    yield *start, "", _rerun_pose(timeline.T_world_key)
    for name, group in _split_moving(cloud).items():
        yield *start, f"cloud/{name}", points(group.points, group, _POINT)
    paths = [track.T_key_object[:, :3, 3] for track in timeline.tracks]
    yield *start, "movers/path", rr.LineStrips3D(paths)
    for sweep in timeline.sweeps:
        now = sweep.frame, sweep.stamp_ns
        yield *now, "sweep", points(sweep.points.rigid_points, sweep.points, _SWEEP_POINT)
        yield *now, "vehicle", _rerun_pose(sweep.T_key_lidar)
        yield *now, "movers/box", _rerun_boxes(sweep.boxes)
    for shot in timeline.shots:
        for name, shown in _rerun_shot(shot):
            yield timeline.key, shot.stamp_ns, f"{shot.name}/{name}", shown


def _rerun_shot(shot: Shot) -> Iterator[tuple[str, Any]]:
    """Yield (entity path below the camera, rerun object) for pose, lens, image and depth."""
    import rerun as rr

    yield "", _rerun_pose(poses.inverse(shot.view.T_cam_key))
    if shot.is_pinhole:
        camera, axes = shot.view.camera, rr.ViewCoordinates.RDF
        size_px = [camera.width_px, camera.height_px]
        yield "", rr.Pinhole(image_from_camera=camera.K, resolution=size_px, camera_xyz=axes)
    if shot.jpeg is not None:
        yield "image", rr.EncodedImage(contents=shot.jpeg, media_type="image/jpeg")
    for name, depth_m in shot.maps_m.items():
        yield name, rr.DepthImage(depth_m, meter=1.0, colormap="viridis")


def _rerun_boxes(boxes: Sequence[ShownBox]) -> Any:
    import rerun as rr

    turns = [Rotation.from_matrix(box.T_key_object[:3, :3]) for box in boxes]
    return rr.Boxes3D(
        centers=[box.T_key_object[:3, 3] for box in boxes],
        half_sizes=[box.size_m / 2 for box in boxes],
        quaternions=[turn.as_quat() for turn in turns],
        labels=[f"{box.instance}: {box.speed_m_s:.1f} m/s" for box in boxes],
    )


def _rerun_pose(T: Float) -> Any:
    import rerun as rr

    return rr.Transform3D(translation=T[:3, 3], mat3x3=T[:3, :3])


def show_in_open3d(runs: Sequence[FinishedRun]) -> None:
    """Show points and boxes, with a time line of several runs, until the window is closed."""
    o3d, shown = import_extra("open3d", "open3d", "Windows with the cloud"), []
    for time, timeline in enumerate(timelines(runs)):
        for group, points in _split_moving(timeline.cloud).items():
            geometry = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(points.points))
            geometry.colors = o3d.utility.Vector3dVector(points.shown_rgb / 255)
            geometry.transform(timeline.T_world_key)
            name = f"key {timeline.key}, {group}"
            shown.append({"name": name, "geometry": geometry, "group": group, "time": time})
        for box in _boxes_at(timeline.tracks, timeline.key):
            T = timeline.T_world_key @ box.T_key_object
            geometry = o3d.geometry.OrientedBoundingBox(T[:3, 3], T[:3, :3], box.size_m)
            name = f"key {timeline.key}, object {box.instance}"
            shown.append({"name": name, "geometry": geometry, "group": "objects", "time": time})
    try:
        o3d.visualization.draw(shown, title="densify", show_ui=True, show_skybox=False)
    except RuntimeError as error:
        raise InputError(
            f"open3d cannot open a window here ({error}): it needs a screen with its drivers; "
            f"densify report makes a page for any browser"
        ) from None


def write_mp4(runs: Sequence[FinishedRun], folder: Path) -> None:
    """Write ``video/CAMERA.mp4`` with a frame for each map, in the order of runs and images."""
    shots: dict[str, list[tuple[FinishedRun, str]]] = {}
    for run in runs:
        for name in run.chosen_maps:
            shots.setdefault(name.partition("/")[0], []).append((run, name))
    (folder / "video").mkdir()
    for camera, of_camera in shots.items():
        path = folder / "video" / f"{camera}.mp4"
        pictures = (_picture(run, name) for run, name in of_camera)
        first = next(pictures)
        size_px = first.shape[1], first.shape[0]
        code = cv2.VideoWriter.fourcc(*"mp4v")
        video = cv2.VideoWriter(str(path), code, _FRAMES_PER_S, size_px)
        if not video.isOpened():
            raise OutputError(f"{path}: this build of OpenCV writes no MPEG-4 video")
        for number, picture in enumerate([first, *pictures], start=1):
            frame = picture if picture.shape == first.shape else cv2.resize(picture, size_px)
            frame[-_BAR_PX:, : size_px[0] * number // len(of_camera)] = 255
            video.write(frame)
        video.release()


def _picture(run: FinishedRun, name: str) -> Picture:
    """Return an image above its filled depth, as (h,w,3) blue, green, red, and a black bar."""
    depth = colour_depth(metres(run.maps(name)["depth_filled"]))
    panels, jpeg = [depth], run.jpeg(name)
    if jpeg is not None:
        panels.insert(0, decode_image(jpeg, run.folder))
    picture = np.concatenate(panels)
    scale = min(1.0, _MOST_WIDTH_PX / picture.shape[1])
    # MPEG-4 needs even sizes.
    size_px = [2 * int(scale * length / 2) for length in picture.shape[1::-1]]
    shrunk = cv2.resize(picture, size_px, interpolation=cv2.INTER_AREA)
    return cv2.copyMakeBorder(shrunk, 0, _BAR_PX, 0, 0, cv2.BORDER_CONSTANT).astype(np.uint8)
