# SPDX-License-Identifier: MIT
"""Read the contents of ROS messages: points, images, calibrations, transforms and poses."""

from __future__ import annotations

from collections import defaultdict, deque
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from densify.config.errors import InputError
from densify.geometry.poses import inverse
from densify.geometry.types import Camera, Float
from densify.readers import checks
from densify.readers.decoded_files import decode_image
from densify.readers.recorded_poses import PoseTrack
from densify.readers.ros_bag import Bag

_DATATYPES = {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 8: "f8"}
_LIVOX = {"x": "f4", "y": "f4", "z": "f4", "reflectivity": "u1", "offset_time": "u4", "line": "u1"}
_MODELS = {  # densify's lens model, and allowed numbers of coefficients
    "plumb_bob": ("pinhole", (4, 5)),
    "radtan": ("pinhole", (4, 5)),
    "rational_polynomial": ("pinhole", (8, 12, 14)),
    "thin_prism": ("pinhole", (12, 14)),
    "equidistant": ("fisheye", (4,)),
    "fisheye": ("fisheye", (4,)),
    "kannala_brandt4": ("fisheye", (4,)),
}
_PACKED = {  # channels, and OpenCV's conversion to RGB
    "rgb8": (3, None),
    "bgr8": (3, "COLOR_BGR2RGB"),
    "rgba8": (4, "COLOR_RGBA2RGB"),
    "bgra8": (4, "COLOR_BGRA2RGB"),
    "8uc3": (3, "COLOR_BGR2RGB"),
    "mono8": (1, "COLOR_GRAY2RGB"),
    "8uc1": (1, "COLOR_GRAY2RGB"),
    # OpenCV names a mosaic by the second row's second and third pixel, ROS by its first two
    "bayer_rggb8": (1, "COLOR_BayerBG2RGB"),
    "bayer_bggr8": (1, "COLOR_BayerRG2RGB"),
    "bayer_gbrg8": (1, "COLOR_BayerGR2RGB"),
    "bayer_grbg8": (1, "COLOR_BayerGB2RGB"),
    "yuv422": (2, "COLOR_YUV2RGB_UYVY"),
    "uyvy": (2, "COLOR_YUV2RGB_UYVY"),
    "yuv422_yuy2": (2, "COLOR_YUV2RGB_YUYV"),
    "yuyv": (2, "COLOR_YUV2RGB_YUYV"),
}
_GRAY_16 = ("mono16", "16uc1")
_FIXED_M = 1e-6  # frames that move less, in metres or radians, are fixed


def cloud_columns(message: Any, where: str) -> dict[str, NDArray[Any]]:
    """Return the one-number fields of a PointCloud2 or Livox CustomMsg by name, (N,) as stored."""
    if not hasattr(message, "point_step"):
        rows = [tuple(getattr(point, name) for name in _LIVOX) for point in message.points]
        table = np.array(rows, list(_LIVOX.items()))
        return {name: table[name] for name in _LIVOX}
    order, layout = ">" if message.is_bigendian else "<", dict[str, tuple[str, int]]()
    for entry in message.fields:
        if entry.count > 1 or not entry.name or entry.name in layout:
            continue
        kind = _DATATYPES.get(entry.datatype)
        if kind is None or entry.offset + int(kind[1]) > message.point_step:
            raise InputError(
                f"{where}: field {entry.name}: got type {entry.datatype} at byte {entry.offset} of "
                f"{message.point_step}, expected one of ROS's eight types inside the point"
            )
        layout[entry.name] = (order + kind, entry.offset)
    formats, offsets = [kind for kind, _ in layout.values()], [at for _, at in layout.values()]
    spec: Any = {"names": [*layout], "formats": formats, "offsets": offsets}
    # Some drivers leave the step of an only row at zero.
    step = message.row_step or message.width * message.point_step * (message.height == 1)
    points_of_rows = _rows(message, step, message.point_step, where)
    points = points_of_rows.reshape(-1).view(np.dtype(spec | {"itemsize": message.point_step}))
    return {name: points[name] for name in layout}


def _rows(message: Any, step: int, item_bytes: int, where: str) -> NDArray[np.uint8]:
    """Return a message's data without row padding, as bytes (height, width · item_bytes)."""
    data, used = np.ascontiguousarray(message.data, np.uint8), message.width * item_bytes
    if step < used or len(data) < message.height * step:
        raise InputError(
            f"{where}: got {len(data)} bytes and rows of {step}, expected {message.height} rows of "
            f"{message.width} times {item_bytes} bytes"
        )
    rows = data[: message.height * step].reshape(message.height, step)
    return np.ascontiguousarray(rows[:, :used])


def check_encoding(message: Any, where: str) -> None:
    """Raise InputError for an Image or CompressedImage message in an encoding that is not read."""
    if hasattr(message, "format"):
        begin = bytes(np.asarray(message.data[:8], np.uint8))
        if not begin.startswith((b"\xff\xd8", b"\x89PNG")):
            raise InputError(
                f"{where}: got images of the format {message.format!r}, expected JPEG or PNG; "
                f"leave the camera out: name others with #images="
            )
    elif message.encoding.lower() not in (*_PACKED, *_GRAY_16):
        raise InputError(
            f"{where}: got the encoding {message.encoding}, expected one of "
            f"{', '.join(_PACKED)}, mono16; leave the camera out: name others with #images="
        )


def image_rgb(message: Any, where: str) -> NDArray[np.uint8]:
    """Return an Image or CompressedImage message as (H,W,3) uint8 RGB."""
    import cv2

    check_encoding(message, where)
    if hasattr(message, "format"):
        bgr = decode_image(np.ascontiguousarray(message.data, np.uint8).tobytes(), where)
        return np.ascontiguousarray(bgr[:, :, ::-1], dtype=np.uint8)
    encoding, size = message.encoding.lower(), (message.height, message.width)
    if encoding in _GRAY_16:
        order = ">u2" if message.is_bigendian else "<u2"
        gray = _rows(message, message.step, 2, where).view(order).reshape(size) >> 8
        return cv2.cvtColor(gray.astype(np.uint8), cv2.COLOR_GRAY2RGB).astype(np.uint8)
    channels, conversion = _PACKED[encoding]
    pixels = _rows(message, message.step, channels, where).reshape(*size, channels)
    if conversion is None:
        return pixels
    return np.ascontiguousarray(cv2.cvtColor(pixels, getattr(cv2, conversion)), dtype=np.uint8)


def camera_of(info: Any, name: str, T_optical_lidar: Float, rectified: bool, where: str) -> Camera:
    """Convert a CameraInfo message to a camera, adjusted for binning and region of interest.

    ``T_optical_lidar`` is the (4,4) pose of the lidar in the message's optical frame. Rectified
    images use P and the rotation R, raw images K and the distortion D.
    """
    matrix = {  # ROS 1 writes K, ROS 2 k
        key: np.asarray(getattr(info, key if hasattr(info, key) else key.upper()), np.float64)
        for key in "kdrp"
    }
    K = (matrix["p"].reshape(3, 4)[:, :3] if rectified else matrix["k"].reshape(3, 3)).copy()
    if not np.isfinite(K).all() or min(K[0, 0], K[1, 1]) <= 0 or abs(K[2, 2] - 1) > 1e-6:
        raise InputError(
            f"{where}: got {'P' if rectified else 'K'} = {np.round(K.ravel(), 4).tolist()}, "
            f"expected a calibration with positive focal lengths"
        )
    if min(info.width, info.height) < 1:
        raise InputError(f"{where}: got {info.width} x {info.height} px, expected the image's size")
    T, model, distortion = T_optical_lidar, "pinhole", tuple[float, ...]()
    if not rectified:
        model, distortion = _lens(info.distortion_model, tuple(matrix["d"].tolist()), where)
    elif matrix["r"].any():  # drivers leave zeros where they do not say
        T = checks.rigid(np.column_stack([matrix["r"].reshape(3, 3), np.zeros(3)]), where) @ T
    camera = Camera(name, int(info.width), int(info.height), K, T, distortion, model)
    return _binned(camera, info)


def _lens(named: str, distortion: tuple[float, ...], where: str) -> tuple[str, tuple[float, ...]]:
    """Return densify's lens model and coefficients for ROS's distortion model and D."""
    model, counts = _MODELS.get(named, ("pinhole", ()))
    if not any(distortion) and model == "pinhole":
        return "pinhole", ()
    if len(distortion) not in counts:
        raise InputError(
            f"{where}: got {len(distortion)} coefficients of the distortion model {named!r}, "
            f"expected one of {', '.join(_MODELS)}, with "
            f"{' or '.join(str(n) for n in counts) or 'its'} coefficients; name rectified images "
            f"with #images="
        )
    return model, distortion


def _binned(camera: Camera, info: Any) -> Camera:
    """Adjust a camera to the region of interest and the binning of a CameraInfo."""
    # Binning averages sensor pixels, which moves pixel centres relative to the corner.
    roi, by = info.roi, np.array([max(1, info.binning_x), max(1, info.binning_y)])
    size = [roi.width or camera.width_px, roi.height or camera.height_px]
    K = camera.K.copy()
    K[:2, 2] -= (roi.x_offset, roi.y_offset)
    K[:2, 2] = (K[:2, 2] + 0.5) / by - 0.5
    K[[0, 1], [0, 1]] /= by
    return replace(camera, K=K, width_px=int(size[0] // by[0]), height_px=int(size[1] // by[1]))


# Transforms


@dataclass(frozen=True)
class Transforms:
    """The tree of coordinate frames of a bag."""

    where: str  # path of the bag, for messages
    # Name of the parent frame and the constant pose T_parent_child (4,4), by child frame
    fixed: dict[str, tuple[str, Float]] = field(default_factory=dict)
    # Name of the parent frame and the path T_parent_child over time, by child frame
    moving: dict[str, tuple[str, PoseTrack]] = field(default_factory=dict)

    @staticmethod
    def read(bag: Bag) -> Transforms:
        """Read all transforms of /tf_static and /tf. A frame that never moves in /tf is fixed."""
        tree = Transforms(str(bag.path))
        heard: dict[tuple[str, str], dict[int, Float]] = defaultdict(dict)
        for topic in bag.of_type("tf2_msgs/msg/TFMessage", "tf/msg/tfMessage"):
            transforms = (t for message in bag.messages(topic.name) for t in message.transforms)
            for transform in transforms:
                parent, child = plain(transform.header.frame_id), plain(transform.child_frame_id)
                where = f"{bag.path}: {topic.name}: {parent} to {child}"
                T = _pose(transform.transform.translation, transform.transform.rotation, where)
                if topic.name.endswith("tf_static"):
                    tree.fixed[child] = (parent, T)
                else:
                    heard[parent, child][stamp_of(transform.header)] = T
        for (parent, child), by_stamp in heard.items():
            T = np.stack([by_stamp[stamp] for stamp in sorted(by_stamp)])
            if child not in tree.fixed and np.abs(T - T[0]).max() < _FIXED_M:
                tree.fixed[child] = (parent, T[0])
            elif child not in tree.fixed:
                track = _track(f"{bag.path}: /tf: {parent} to {child}", by_stamp)
                tree.moving[child] = (parent, track)
        return tree

    def between(self, target: str, source: str) -> Float | None:
        """Return T_target_source (4,4) along fixed frames; None if no fixed frames join the two."""
        neighbors_of: dict[str, list[tuple[str, Float]]] = defaultdict(list)
        for child, (parent, T) in self.fixed.items():
            neighbors_of[child].append((parent, T))
            neighbors_of[parent].append((child, inverse(T)))
        T_frame_source, waiting = {source: np.eye(4)}, deque([source])
        while waiting:
            frame = waiting.popleft()
            for neighbor, T_neighbor_frame in neighbors_of[frame]:
                if neighbor not in T_frame_source:
                    T_frame_source[neighbor] = T_neighbor_frame @ T_frame_source[frame]
                    waiting.append(neighbor)
        return T_frame_source.get(target)

    def track_of(self, frame: str) -> tuple[str, PoseTrack] | None:
        """Return a frame's moving parent and path T_parent_frame in it; None if it is fixed."""
        # The nearest moving parent is usually odom, not map, which jumps at loop closures.
        T_body_frame, body, passed = np.eye(4), frame, {frame}
        while body in self.fixed and body not in self.moving:
            parent, T = self.fixed[body]
            T_body_frame, body = T @ T_body_frame, parent
            if body in passed:
                raise InputError(f"{self.where}: /tf_static: {body} is above itself")
            passed.add(body)
        if body not in self.moving:
            return None
        world, track = self.moving[body]
        return world, PoseTrack(track.where, track.stamp_ns, track.T_world_ego @ T_body_frame)


def recorded_track(bag: Bag, topic: str, transforms: Transforms, lidar: str) -> PoseTrack:
    """Read the path T_world_lidar of frame ``lidar`` from a topic of odometry or poses."""
    by_stamp, where = dict[int, Float](), f"{bag.path}: {topic}"
    for message in bag.messages(topic):
        pose = message.pose.pose if hasattr(message.pose, "pose") else message.pose
        # Poses without a child frame are assumed to be poses of the lidar itself.
        child = plain(getattr(message, "child_frame_id", "")) or lidar
        T_child_lidar = transforms.between(child, lidar)
        if T_child_lidar is None:
            raise InputError(
                f"{where}: nothing in /tf_static joins its frame {child} to the lidar's, {lidar}; "
                f"name other poses, or none: #poses=none"
            )
        T = _pose(pose.position, pose.orientation, where)
        by_stamp[stamp_of(message.header)] = T @ T_child_lidar
    return _track(where, by_stamp)


def _track(where: str, by_stamp: dict[int, Float]) -> PoseTrack:
    T = np.reshape([by_stamp[stamp] for stamp in sorted(by_stamp)], (-1, 4, 4))
    return PoseTrack(where, np.array(sorted(by_stamp), np.int64), T)


def plain(frame: str) -> str:
    """Return the name of a frame without leading and trailing slashes, as in ROS 2."""
    return frame.strip("/")


def stamp_of(header: Any) -> int:
    """Return the stamp of a message header in nanoseconds."""
    return int(header.stamp.sec) * 1_000_000_000 + int(header.stamp.nanosec)


def _pose(position: Any, rotation: Any, where: str) -> Float:
    quaternion = (rotation.w, rotation.x, rotation.y, rotation.z)
    return checks.quaternion_pose(quaternion, (position.x, position.y, position.z), where)
