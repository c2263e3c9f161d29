# SPDX-License-Identifier: MIT
"""Which topics of a bag are the sweeps, the images and the poses: as named, or guessed."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple
from urllib.parse import parse_qsl

from densify.config.errors import InputError
from densify.readers.ros.bag import Bag, Topic

CLOUD = "sensor_msgs/msg/PointCloud2"
LIVOX = tuple(
    f"{package}/msg/CustomMsg"
    for package in ("livox_ros_driver", "livox_ros_driver2", "livox_interfaces")
)
IMAGES = ("sensor_msgs/msg/Image", "sensor_msgs/msg/CompressedImage")
INFO = "sensor_msgs/msg/CameraInfo"
ODOMETRY = "nav_msgs/msg/Odometry"
POSES = (
    ODOMETRY,
    "geometry_msgs/msg/PoseStamped",
    "geometry_msgs/msg/PoseWithCovarianceStamped",
)
_OPTIONS = ("points", "images", "poses")
_USAGE = "#points=/topic,/topic&images=/topic,/topic&poses=/topic, tf or none"
_PACKETS = (
    "VelodyneScan",
    "VelodynePacket",
    "PacketMsg",
    "PandarScan",
    "HesaiPacket",
    "UdpFrame",
    "NebulaPackets",
    "RslidarPacket",
    "RslidarScan",
    "LivoxPacket",
    "BlickfeldPackets",
)
_NO_SWEEPS = (
    "map",
    "depth",
    "filtered",
    "obstacle",
    "ground",
    "cluster",
    "voxel",
    "radar",
    "local",
    "global",
    "accumulated",
    "registered",
)
_NO_PICTURES = ("depth", "disparity", "theora", "mask", "confidence")
_BEST_IMAGES = ("image_rect_color", "image_rect", "image_color", "image_raw", "image")


class Images(NamedTuple):
    """camera: its name. topic: of its images. info: topic of its calibration. named: by the user,
    so that whatever is wrong with it is an error."""

    camera: str
    topic: str
    info: str
    named: bool

    @property
    def rectified(self) -> bool:
        return "rect" in self.topic.removesuffix("/compressed").rpartition("/")[2]


@dataclass(frozen=True)
class Topics:
    """points: of the lidars, the first one's sweeps count. poses: a topic, ``tf``, or "" for none;
    poses_named: by the user. left_out: images that are not used, and why."""

    points: tuple[str, ...]
    images: tuple[Images, ...]
    poses: str
    poses_named: bool
    left_out: tuple[str, ...]

    @staticmethod
    def choose(bag: Bag, options: str | None) -> Topics:
        """options: what follows ``#``. Raises InputError for topics that do not exist, several that
        could be the sweeps, and bags without any."""
        given = _parsed(bag, options)
        points = tuple(t.name for t in _points(bag, given.get("points")))
        images, left_out = _images(bag, given.get("images"))
        poses = given.get("poses", "")
        if poses and poses not in ("none", "tf"):
            _existing(bag, [poses], POSES, "poses")
        if not poses:
            odometry = bag.of_type(ODOMETRY)
            poses = odometry[0].name if len(odometry) == 1 else "tf"
        poses = "" if poses == "none" else poses
        return Topics(points, images, poses, "poses" in given, left_out)


def _parsed(bag: Bag, options: str | None) -> dict[str, str]:
    given = dict(parse_qsl(options or "", keep_blank_values=True))
    wrong = [key for key in given if key not in _OPTIONS]
    if wrong or (options and not given):
        raise InputError(
            f"{bag.path}#{options}: got {wrong[0] if wrong else options}, expected {_USAGE}"
        )
    return given


def _points(bag: Bag, given: str | None) -> list[Topic]:
    if given is not None:
        return _existing(bag, given.split(","), (CLOUD, *LIVOX), "points")
    found = bag.of_type(CLOUD, *LIVOX)
    likely = [t for t in found if not any(word in t.name.lower() for word in _NO_SWEEPS)]
    if len(likely) == 1 or len(found) == 1:
        return likely or found
    if found:
        raise InputError(
            f"{bag.path}: several topics could be the sweeps: {_listed(likely or found)}; name one "
            f"or all lidars of the vehicle: --data 'ros:{bag.path}#points=/topic,/topic'"
        )
    packets = [t for t in bag.topics.values() if t.type.rpartition("/")[2] in _PACKETS]
    if packets:
        raise InputError(
            f"{bag.path}: holds raw packets only ({_listed(packets)}), no PointCloud2; play it "
            f"through the sensor's driver (such as velodyne_pointcloud or ouster_ros) and record "
            f"the points that come out, or give the packets as .pcap"
        )
    raise InputError(
        f"{bag.path}: no PointCloud2; got {_listed(list(bag.topics.values())) or 'no messages'}"
    )


def _images(bag: Bag, given: str | None) -> tuple[tuple[Images, ...], tuple[str, ...]]:
    if given == "none":
        return (), ()
    if given is not None:
        chosen = [t.name for t in _existing(bag, given.split(","), IMAGES, "images")]
    else:
        chosen = _guessed_images([t.name for t in bag.of_type(*IMAGES)])
    found, left_out = [], []
    for topic in chosen:
        info = f"{_place(topic)}/camera_info"
        if info in bag.topics:
            found.append(Images(_camera_name(topic, chosen), topic, info, given is not None))
        elif given is not None:
            raise InputError(
                f"{bag.path}: no {info} with the calibration of {topic}; leave it out of #images="
            )
        else:
            left_out.append(f"{topic}: no {info} with its calibration")
    return tuple(found), tuple(left_out)


def _guessed_images(topics: Sequence[str]) -> list[str]:
    """The best of each place: rectified before raw, whole before compressed."""
    best: dict[str, tuple[int, str]] = {}
    for topic in topics:
        if any(word in topic.lower() for word in _NO_PICTURES):
            continue
        last = topic.removesuffix("/compressed").rpartition("/")[2]
        rank = _BEST_IMAGES.index(last) if last in _BEST_IMAGES else len(_BEST_IMAGES)
        order = (2 * rank + topic.endswith("/compressed"), topic)
        best[_place(topic)] = min(best.get(_place(topic), order), order)
    return [topic for _, topic in best.values()]


def _place(topic: str) -> str:
    """``/front/image_raw/compressed`` -> ``/front``, where its calibration is too."""
    return topic.removesuffix("/compressed").rpartition("/")[0]


def _camera_name(topic: str, among: Sequence[str]) -> str:
    """A name fit for files, from the parts of the topic that tell cameras apart."""
    place = _place(topic)
    if [_place(other) for other in among].count(place) > 1:
        place = topic
    return place.strip("/").replace("/", "_") or "camera"


def _existing(bag: Bag, names: Sequence[str], types: Sequence[str], what: str) -> list[Topic]:
    for name in names:
        topic = bag.topics.get(name)
        if topic is None or topic.type not in types:
            got = "no such topic" if topic is None else f"a topic of {topic.type}"
            fit = _listed(bag.of_type(*types)) or "none"
            raise InputError(f"{bag.path}: {what}={name}: {got}; topics that fit: {fit}")
    return [bag.topics[name] for name in names]


def _listed(topics: Sequence[Topic]) -> str:
    return ", ".join(f"{t.name} ({t.type.rpartition('/')[2]}, {t.num_messages})" for t in topics)
