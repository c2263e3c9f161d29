# SPDX-License-Identifier: MIT
"""A street as a ROS bag: PointCloud2 stamped at the sweep's start, images, odometry, /tf_static."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from ros_bags import Maker

from densify.geometry.poses import inverse
from writers.excerpt import Excerpt

T_BASE_LIDAR = np.eye(4)
T_BASE_LIDAR[:3, 3] = [1.2, 0.0, 1.6]


def write_ros1(excerpt: Excerpt, out: Path) -> Path:
    return _write(excerpt, out / "street_ros1", Maker(".bag"))


def write_ros2(excerpt: Excerpt, out: Path) -> Path:
    return _write(excerpt, out / "street_ros2", Maker(".mcap"))


def _write(excerpt: Excerpt, place: Path, maker: Maker) -> Path:
    street = excerpt.street
    half_ns = street.simulator.period_ns // 2
    stamps_ns = [street.stamp_ns(frame) - half_ns for frame in excerpt.frames]
    maker.transform("base_link", "lidar", T_BASE_LIDAR, stamp_ns=stamps_ns[0])
    for frame, stamp_ns in zip(excerpt.frames, stamps_ns, strict=True):
        returns = excerpt.returns(frame)
        columns = dict(zip("xyz", returns.points.astype("f4").T, strict=True))
        columns["intensity"] = (returns.intensity * 255).astype("f4")
        columns["t"] = (returns.offset_ns + half_ns).astype("u4")
        maker.cloud(columns, stamp_ns)
    for name in excerpt.cameras:
        camera, last = street.cameras[name], "image_rect_color"
        T = T_BASE_LIDAR @ inverse(camera.T_cam_lidar)
        maker.transform("base_link", f"{name}_optical", T, stamp_ns=stamps_ns[0])
        P = np.column_stack([camera.K, np.zeros(3)]).ravel()
        frame_id, size = f"{name}_optical", (camera.height_px, camera.width_px)
        maker.info(f"/{name}/camera_info", size, frame=frame_id, k=camera.K.ravel(), p=P)
        for number in excerpt.image_numbers(name):
            stamp_ns, rgb = street.image_stamps_ns(name)[number], street.image(name, number)
            if maker.is_ros2:
                maker.image(rgb, "rgb8", f"/{name}/{last}", stamp_ns=stamp_ns, frame=frame_id)
            else:
                topic, data = f"/{name}/{last}/compressed", excerpt.png_image(name, number)
                maker.compressed(data, topic, stamp_ns, frame_id)
    track = excerpt.poses(inverse(T_BASE_LIDAR))
    for stamp_ns, T in zip(track.stamp_ns.tolist(), track.T_world_ego, strict=True):
        maker.odometry(T, stamp_ns, "base_link")
    place.mkdir(parents=True)
    bag = maker.write(place)
    if maker.is_ros2:
        for file in bag.iterdir():
            file.rename(place / file.name)
        bag.rmdir()
    excerpt.write_truth(place / "truth", stamps_ns)
    return place
