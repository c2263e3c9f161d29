# SPDX-License-Identifier: MIT
"""``densify.yaml`` beside a recording of no known form: what its files cannot say themselves. Every
key may be left out; `densify.readers.folder.reader` says what is then found or assumed.
"""

from __future__ import annotations

import re
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from densify.config.errors import InputError
from densify.geometry.types import Camera, Float
from densify.readers.file_sequence import rigid
from densify.readers.folder.yaml_sections import Section, read_sections
from densify.readers.point_fields import REFERENCES, UNIT_NS

NAME = "densify.yaml"
_MODELS = {"pinhole": (0, 4, 5, 8, 12, 14), "fisheye": (4,), "mei": (5,)}


@dataclass(frozen=True)
class SweepFiles:
    """Section ``sweeps``.

    files: folder of the sweeps, "" to look for it. columns: of files without names. scale_m:
    metres of a unit of the points. R_lidar_stored: (3,3), from key ``axes``, turns (or mirrors)
    stored points to the lidar's frame, x forward, y left, z up; None leaves them. intensity,
    time, lidar, radial_velocity: which column plays that part, "" to find it by its name.
    intensity_scale: what is full brightness, 0 to find it. time_unit, absolute, reference: as
    `densify.readers.point_fields.find_times`. stamps: ``names`` (of the files) or a file with one
    time for each sweep, "" to look for them; stamps_unit: theirs. rate_hz: of sweeps without
    stamps, 0 to take it from the points' times. compensated: the points were carried to the
    stamp by the vehicle's motion. scanner_origins: (S,3) metres, None where rays start at 0 0 0.
    """

    files: str = ""
    columns: tuple[str, ...] | None = None
    scale_m: float = 1.0
    R_lidar_stored: Float | None = None
    intensity: str = ""
    intensity_scale: float = 0.0
    time: str = ""
    time_unit: str = ""
    absolute: bool | None = None
    reference: str = ""
    lidar: str = ""
    radial_velocity: str = ""
    stamps: str = ""
    stamps_unit: str = ""
    rate_hz: float = 0.0
    compensated: bool = False
    scanner_origins: Float | None = None

    @staticmethod
    def of(section: Section) -> SweepFiles:
        kind = section.choice("time_is", ("relative", "absolute"))
        found = SweepFiles(
            files=section.text("files"),
            columns=section.names("columns"),
            scale_m=section.number("scale_m", 1.0, above=0.0),
            R_lidar_stored=_axes(section),
            intensity=section.text("intensity"),
            intensity_scale=section.number("intensity_scale", 0.0, above=0.0),
            time=section.text("time"),
            time_unit=section.choice("time_unit", tuple(UNIT_NS)),
            absolute=None if not kind else kind == "absolute",
            reference=section.choice("reference", REFERENCES),
            lidar=section.text("lidar"),
            radial_velocity=section.text("radial_velocity"),
            stamps=section.text("stamps"),
            stamps_unit=section.choice("stamps_unit", tuple(UNIT_NS)),
            rate_hz=section.number("rate_hz", 0.0, above=0.0),
            compensated=bool(section.flag("compensated", False)),
            scanner_origins=section.numbers("scanner_origins", (-1, 3)),
        )
        section.done()
        return found


@dataclass(frozen=True)
class Poses:
    """Section ``poses``. file: "" to look for it. T_frame_lidar: (4,4) the lidar in the frame whose
    poses these are. inverse: the file has T_lidar_world, not T_world_lidar."""

    file: str = ""
    stamps_unit: str = ""
    T_frame_lidar: Float | None = None
    inverse: bool = False

    @staticmethod
    def of(section: Section) -> Poses:
        found = Poses(
            file=section.text("file"),
            stamps_unit=section.choice("stamps_unit", tuple(UNIT_NS)),
            T_frame_lidar=_pose(section, "T_frame_lidar"),
            inverse=bool(section.flag("inverse", False)),
        )
        section.done()
        return found


@dataclass(frozen=True)
class CameraFiles:
    """One of the section ``cameras``. files: folder of its images. stamps: ``names``, ``sweeps``
    (an image is exposed when the sweep of its number is stamped), or a file, "" to look for them.
    clock_offset_s: is added to the stamps, to bring them to the sweeps' clock."""

    camera: Camera
    files: str
    stamps: str = ""
    stamps_unit: str = ""
    clock_offset_s: float = 0.0

    @staticmethod
    def of(section: Section, name: str) -> CameraFiles:
        if not re.fullmatch(r"[\w.-]+", name) or name.startswith("."):
            raise InputError(
                f"{section.where}: cameras: got the name {name!r}, expected letters, digits, _ - ."
            )
        for key in ("files", "size", "K", "T_cam_lidar"):
            if not section.has(key):
                expected = {
                    "files": "the folder of its images",
                    "size": "[width, height] in pixels",
                    "K": "[fx, fy, cx, cy] or three rows",
                    "T_cam_lidar": "four rows, from the lidar's frame to the camera's (x right, "
                    "y down, z forward)",
                }[key]
                raise section.wrong(key, expected)
        found = CameraFiles(
            camera=_camera(section, name),
            files=section.text("files"),
            stamps=section.text("stamps"),
            stamps_unit=section.choice("stamps_unit", tuple(UNIT_NS)),
            clock_offset_s=section.number("clock_offset_s", 0.0),
        )
        section.done()
        return found


@dataclass(frozen=True)
class FolderConfig:
    """path: of the file, None where there is none."""

    path: Path | None = None
    sweeps: SweepFiles = field(default_factory=SweepFiles)
    poses: Poses = field(default_factory=Poses)
    cameras: tuple[CameraFiles, ...] = ()

    @staticmethod
    def read(folder: Path) -> FolderConfig:
        """Raises InputError that names file, line and key of whatever is wrong."""
        path = folder / NAME
        if not path.is_file():
            return FolderConfig()
        root = read_sections(path)
        cameras = root.section("cameras").sections()
        found = FolderConfig(
            path,
            SweepFiles.of(root.section("sweeps")),
            Poses.of(root.section("poses")),
            tuple(CameraFiles.of(section, name) for name, section in cameras.items()),
        )
        root.done()
        return found


def _camera(section: Section, name: str) -> Camera:
    size = section.numbers("size", (2,))
    if size is None or min(size) < 1 or any(size % 1):
        raise section.wrong("size", "[width, height] in whole pixels")
    model = section.choice("model", tuple(_MODELS), "pinhole")
    distortion = section.numbers("distortion", (-1,))
    coefficients = () if distortion is None else tuple(float(d) for d in distortion)
    if model == "pinhole" and not any(coefficients):
        coefficients = ()
    if len(coefficients) not in _MODELS[model]:
        counts = ", ".join(str(n) for n in _MODELS[model])
        raise section.wrong("distortion", f"{counts} coefficients for a {model} camera")
    K, T = _K(section), _pose(section, "T_cam_lidar")
    return Camera(
        name=name,
        width_px=int(size[0]),
        height_px=int(size[1]),
        K=K,
        T_cam_lidar=np.eye(4) if T is None else T,
        distortion=coefficients,
        model=model,
        max_angle_deg=section.number("max_angle_deg", 180.0, above=0.0),
        row_time_s=section.number("row_time_s", 0.0),
    )


def _axes(section: Section) -> Float | None:
    """(3,3) of three names such as [z, -x, -y]: where the lidar's x, y and z stand in the file."""
    names = section.names("axes")
    if names is None:
        return None
    signed = {
        s + a: (-1.0 if s else 1.0) * np.eye(3)["xyz".index(a)] for s in ("", "-") for a in "xyz"
    }
    R = np.array([signed.get(name, np.zeros(3)) for name in names])
    if R.shape != (3, 3) or not np.allclose(R @ R.T, np.eye(3)):
        raise section.wrong("axes", "x, y and z in some order, some with a -, such as [z, -x, -y]")
    return R


def _K(section: Section) -> Float:
    expected = "[fx, fy, cx, cy] or three rows, the last one 0 0 1, with fx and fy above 0"
    K = section.numbers("K", (3, 3), (4,))
    if K is None:
        raise section.wrong("K", expected)
    if K.shape == (4,):
        fx, fy, cx, cy = K
        K = np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1.0]])
    if min(K[0, 0], K[1, 1]) <= 0 or not np.allclose(K[[1, 2, 2, 2], [0, 0, 1, 2]], [0, 0, 0, 1]):
        raise section.wrong("K", expected)
    return K


def _pose(section: Section, key: str) -> Float | None:
    T = section.numbers(key, (4, 4), (3, 4))
    return None if T is None else rigid(T, section.place(key))
