# SPDX-License-Identifier: MIT
"""Provide the built-in simulated street as a recording. Frames are rendered on demand and cached.

``street[:PRESET][?seed=N&sensor=NAME&hz=RATE&tilt=DEG&cameras=NAME,NAME]``, 16 seconds long. The
cache (DENSIFY_CACHE_DIR, or the user's) may be deleted: rendering is reproducible byte for byte.

Exact truth is the motion of bodies, and the body of each point. A body is a rigid part of the
scene; body 0 is the static world. A ``truth/`` folder beside a written recording has::

    bodies.npz             T_world_lidar (F,4,4): scanner poses at the reference times of F frames
                           T_world_body (F,B,4,4): poses of B bodies at the reference times
                           moving (F,B) bool: the body's object moves around the reference time
    points/0000000120.npz  arrays for the N raw points of the sweep, row by row: body (N,) int32,
                           instance (N,) int32 (-1 none), point (N,3) float64 in the body's frame
    depth/image_02/0000000120.npz  depth_m (H,W) float32: camera z at the exposure, 0 if empty
                           moving (H,W) bool: pixels of moving objects
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import cached_property, lru_cache, partial
from pathlib import Path
from threading import Lock
from typing import Any
from urllib.parse import parse_qsl

import numpy as np
from numpy.typing import NDArray

from densify.config.cache import Cache, get_cached, own_folder
from densify.config.errors import InputError
from densify.geometry.compiled import num_threads
from densify.geometry.types import Bool, Camera, Float, Float32, Sweep, SweepTruth
from densify.geometry.types.recordings import in_one_line
from densify.readers.decoded_files import read_arrays
from densify.street.cameras import CAMERAS, USUAL, Picture, cameras_beside
from densify.street.lidar import SENSORS, Returns
from densify.street.scenes import PRESETS
from densify.street.simulator import VERSION, Bodies, Simulator

_progress = logging.getLogger("densify.progress")
_BODIES = ("T_world_lidar", "T_world_body", "moving")
_SWEEPS_IN_MEMORY, _IMAGES_IN_MEMORY = 16, 8
_OPTIONS = {"seed": "0", "sensor": "hdl64", "hz": "10", "tilt": "0", "cameras": ",".join(USUAL)}
_NUMBERS = "expected degrees of tilt from -45 to 45, hz 5, 10, 20, seed a whole number from 0"


class Street:
    """The built-in simulated street, 16 seconds long, with the members of a `LidarSequence`."""

    def __init__(
        self,
        preset: str = "street",
        seed: int = 0,
        sensor: str = "hdl64",
        hz: int = 10,
        tilt_deg: float = 0.0,
        cameras: tuple[str, ...] = USUAL,
    ) -> None:
        """Set up the street. Values that are unknown or out of range raise InputError.

        Args:
            preset: "street", "highway", "static" (only the ego vehicle moves) or "crossing" (the
                ego vehicle stands).
            seed: Number from 0 that determines the random values.
            sensor: Name of a lidar in `densify.street.lidar.SENSORS`.
            hz: Sweeps per second: 5, 10 or 20.
            tilt_deg: Pitch of the lidar's mount, nose down. Cameras are not tilted.
            cameras: Names of the cameras.
        """
        _check("preset", preset, PRESETS)
        _check("sensor", sensor, SENSORS)
        if not (0 <= seed < 10**18 and hz in (5, 10, 20) and abs(tilt_deg) <= 45):
            raise InputError(f"street: got seed {seed}, hz {hz}, tilt {tilt_deg:g}; {_NUMBERS}")
        for name in cameras:
            _check("camera", name, CAMERAS)
        options = f"&hz={hz}" * (hz != 10) + f"&tilt={tilt_deg:g}" * (tilt_deg != 0)
        shown = f"&cameras={','.join(cameras) or 'none'}" * (cameras != USUAL)
        self.name = f"street:{preset}?seed={seed}&sensor={sensor}{options}{shown}"
        self.simulator = Simulator(preset, seed, SENSORS[sensor], hz, tilt_deg)
        self.frames = range(self.simulator.num_frames)
        self.cameras: Mapping[str, Camera] = cameras_beside(tilt_deg, cameras)
        self.truth = StreetTruth(self)
        self._building = Lock()
        self._cache: Cache | None = Cache(folder=own_folder("street"))
        self._posed = f"{VERSION} {preset} {seed}{options}, with any sensor"
        self._swept = f"{VERSION} {preset} {seed} {sensor}{options}"
        pictured = f"{VERSION} {preset} {seed} {hz} Hz, with any sensor"
        render = partial(self._from_cache, "sweep", self._swept, self.simulator.returns)
        self._returns = lru_cache(_SWEEPS_IN_MEMORY)(render)
        render = partial(self._from_cache, "image", pictured, self.simulator.picture)
        self._picture = lru_cache(_IMAGES_IN_MEMORY)(render)

    @staticmethod
    def from_spec(spec: str) -> Street:
        """Return the street of a text such as ``street:crossing?seed=2&sensor=vlp16``."""
        head, _, query = spec.partition("?")
        reader, _, preset = head.partition(":")
        if reader != "street":
            raise InputError(f"{spec!r}: expected street[:PRESET][?OPTION=VALUE&OPTION=VALUE]")
        options = dict(parse_qsl(query, keep_blank_values=True))
        for key in options:
            _check("option", key, _OPTIONS)
        seed, sensor, hz, tilt, cameras = (_OPTIONS | options).values()
        names = () if cameras == "none" else tuple(cameras.split(","))
        try:
            return Street(preset or "street", int(seed), sensor, int(hz), float(tilt), names)
        except ValueError as error:
            raise InputError(f"{spec!r}: {error}; {_NUMBERS}") from None

    def __getitem__(self, frame: int) -> Sweep:
        returns = self.returns(frame)
        return Sweep(
            frame=frame,
            stamp_ns=self.simulator.stamp_ns(frame),
            points=returns.points.astype(np.float64),
            intensity=returns.intensity,
            offset_ns=returns.offset_ns,
            lidar=returns.lidar,
            row=np.arange(len(returns.points)),
            scanner_origins=self.simulator.sensor.origins_m,
        )

    def keep_nothing(self) -> None:
        """Disable the cache folder, for a street that is rendered only once."""
        self._cache = None

    def __repr__(self) -> str:
        return in_one_line(self)

    def stamp_ns(self, frame: int) -> int:
        """Return the reference time of a sweep in nanoseconds since 1970."""
        self.check(frame)
        return self.simulator.stamp_ns(frame)

    def returns(self, frame: int) -> Returns:
        """Return the lidar returns of a sweep as fired, with the simulated bodies that they hit."""
        self.check(frame)
        return self._returns(frame)

    def prepare(self, frames: Sequence[int], images: Sequence[tuple[str, int]] = ()) -> None:
        """Render missing sweeps and images (camera, number) into the cache, on all cores."""
        with ThreadPoolExecutor(num_threads()) as pool:
            list(pool.map(lambda image: self.picture(*image), images))
            list(pool.map(self.returns, frames))

    def picture(self, camera: str, number: int) -> Picture:
        """Return an image with the exact depth and the simulated body of each pixel."""
        stamps_ns = self.image_stamps_ns(camera)
        if number not in stamps_ns:
            raise InputError(
                f"street: no image {number} of {camera}; there are images 0 to {max(stamps_ns)}"
            )
        return self._picture(camera, number)

    def image(self, camera: str, number: int) -> NDArray[np.uint8]:
        """Return image ``number`` of a camera as (H,W,3) uint8 RGB."""
        return self.picture(camera, number).image

    def image_stamps_ns(self, camera: str) -> Mapping[int, int]:
        """Return the exposure times in ns of a camera's images, by image number from 0."""
        _check("camera", camera, self.cameras)
        return self.simulator.image_stamps_ns(camera)

    @cached_property
    def bodies(self) -> Bodies:
        """Poses of the scanner and of all simulated bodies at the reference time of each frame."""
        return get_cached(self._cache, "bodies", lambda: self._posed, lambda: self.simulator.bodies)

    def _from_cache(self, step: str, scene: str, render: Callable[..., Any], *which: Any) -> Any:
        """Return the result for ``scene`` and ``which`` from the cache, or render and keep it."""

        def rendered() -> Any:
            _announce()
            with self._building:
                _ = self.simulator.scene.world.triangles  # made once, for all threads
            return render(*which)

        return get_cached(self._cache, step, lambda: (scene, *which), rendered)

    def T_world_lidar(self, frame: int) -> Float:
        """Return the true pose T_world_lidar (4,4) at the sweep's reference time."""
        self.check(frame)
        return self.bodies.T_world_lidar[frame]

    def check(self, frame: int) -> None:
        """Raise InputError for a frame that does not exist."""
        if frame not in self.frames:
            raise InputError(f"street: no frame {frame}; there are frames 0 to {self.frames[-1]}")


@dataclass(frozen=True)
class StreetTruth:
    """Exact ground truth of a simulated street, with the members of `Truth`."""

    _street: Street

    def sweep(self, frame: int) -> SweepTruth:
        """Return the ground truth of a sweep's N raw points, row by row."""
        returns = self._street.returns(frame)
        points = self._street.simulator.in_bodies(frame, returns)
        return self._street.bodies.sweep(frame, returns.body, returns.instance, points)

    def displacement(self, frame: int, target: int) -> Float:
        """Return the (N,3) true scene flow (m) of a sweep's points to the time of ``target``."""
        self._street.check(target)
        returns = self._street.returns(frame)
        points = self._street.simulator.in_bodies(frame, returns)
        return self._street.bodies.displacement(frame, target, returns.body, points)

    def depth_m(self, camera: str, number: int) -> Float32:
        """Return an image's true depth (H,W) in metres by `Camera.measure`, 0 without a surface."""
        return self._street.picture(camera, number).depth_m

    def moving_mask(self, camera: str, number: int) -> Bool:
        """Return the mask (H,W) of an image, True for pixels of moving objects.

        An object counts as moving if it moves around the reference time nearest to the exposure.
        """
        body = self._street.picture(camera, number).body
        simulator, frames = self._street.simulator, self._street.frames
        since_ns = simulator.image_stamps_ns(camera)[number] - simulator.stamp_ns(0)
        nearest = min(max(round(since_ns / simulator.period_ns), 0), frames[-1])
        moving: Bool = (body >= 0) & self._street.bodies.moving[nearest][body]
        return moving


def write_bodies(folder: Path, bodies: Bodies) -> None:
    """Write the poses of the scanner and all bodies to ``bodies.npz`` in the ``truth`` folder."""
    _save(folder / "bodies.npz", **{name: getattr(bodies, name) for name in _BODIES})


def write_points(
    folder: Path, frame: int, body: NDArray[np.int32], instance: NDArray[np.int32], point: Float
) -> None:
    """Write the ground truth of a sweep's N raw points, row by row, to ``points/FRAME.npz``.

    Args:
        folder: Folder ``truth`` of the recording.
        frame: Frame number of the sweep.
        body: (N,) index of the body that each point is on.
        instance: (N,) number of the point's object, -1 for none.
        point: (N,3) position in metres in the frame of the body.
    """
    path = folder / "points" / f"{frame:010d}.npz"
    _save(path, body=body, instance=instance, point=point)


def write_depth(folder: Path, camera: str, frame: int, depth_m: Float32, moving: Bool) -> None:
    """Write the true depth (H,W) in metres and the mask (H,W) of moving objects of an image."""
    _save(folder / "depth" / camera / f"{frame:010d}.npz", depth_m=depth_m, moving=moving)


def _save(path: Path, **arrays: Any) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    np.savez_compressed(path, **arrays)


class FileTruth:
    """Ground truth (`Truth`) read from a ``truth`` folder."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self.bodies = Bodies(*self._load("bodies.npz", *_BODIES))

    def sweep(self, frame: int) -> SweepTruth:
        """Return the ground truth of a sweep's N raw points, lidar frame at its reference time."""
        body, instance, point = self._points(frame)
        return self.bodies.sweep(frame, body, instance, point)

    def displacement(self, frame: int, target: int) -> Float:
        """Return the (N,3) true scene flow (m) of a sweep's points to the time of ``target``."""
        body, _, point = self._points(frame)
        return self.bodies.displacement(frame, target, body, point)

    def depth_m(self, camera: str, frame: int) -> Float32:
        """Return the true depth (H,W) of an image in metres, 0 for pixels without a surface."""
        depth_m: Float32 = self._load(f"depth/{camera}/{frame:010d}.npz", "depth_m")[0]
        return depth_m

    def moving_mask(self, camera: str, frame: int) -> Bool:
        """Return an (H,W) mask of an image, True for pixels of moving objects."""
        moving: Bool = self._load(f"depth/{camera}/{frame:010d}.npz", "moving")[0]
        return moving

    def _points(self, frame: int) -> tuple[NDArray[np.int32], NDArray[np.int32], Float]:
        """Return body (N,), instance (N,) and body-fixed position (N,3) of a sweep's points."""
        self.bodies.check(frame)
        name, num_bodies = f"points/{frame:010d}.npz", self.bodies.moving.shape[1]
        body, instance, point = self._load(name, "body", "instance", "point")
        if ((body < 0) | (body >= num_bodies)).any():
            raise InputError(
                f"{self._folder / name}: got bodies {body.min()} to {body.max()}, expected bodies "
                f"below {num_bodies}"
            )
        return body, instance, point

    def _load(self, name: str, *columns: str) -> list[NDArray[Any]]:
        path = self._folder / name
        if not path.exists():
            raise InputError(f"{path}: no such truth file; write the frame again")
        arrays = read_arrays(path, columns)
        if missing := [column for column in columns if column not in arrays]:
            raise InputError(f"{path}: holds no {', '.join(missing)}; write the truth again")
        return [arrays[column] for column in columns]


def _check(kind: str, got: str, known: Sequence[str] | Mapping[str, Any]) -> None:
    if got not in known:
        raise InputError(f"street: no {kind} {got!r}; there are {', '.join(known)}")


@lru_cache(1)
def _announce() -> None:
    _progress.info("rendering the street, 1 to 2 s a sweep; kept in the cache")
