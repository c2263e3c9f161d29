# SPDX-License-Identifier: MIT
"""The built-in street as a recording. Frames are rendered when asked for and kept in a folder.

``street[:PRESET][?seed=N&sensor=NAME&hz=RATE&tilt=DEG&cameras=NAME,NAME]``. It lasts 16 seconds: at
10 Hz frames 0 to 159. The cache lies in the user's cache directory, or in the folder named by the
environment variable DENSIFY_CACHE_DIR. It can be deleted at any time: a frame rendered again is the
same, byte for byte.
"""

from __future__ import annotations

import hashlib
import logging
import threading
from collections import OrderedDict
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import cached_property, partial
from typing import Any
from urllib.parse import parse_qsl

import numpy as np
from numpy.typing import NDArray

from densify.config.cache import save_arrays
from densify.config.errors import InputError
from densify.config.user_folder import own_folder
from densify.geometry.threads import num_threads
from densify.geometry.types import Bool, Camera, Float, Float32, Sweep, SweepTruth
from densify.readers.decoded_files import read_arrays
from densify.street.cameras import CAMERAS, USUAL, Picture, cameras_beside
from densify.street.lidar import Returns
from densify.street.sensors import SENSORS
from densify.street.simulator import PRESETS, VERSION, Bodies, Simulator

_log = logging.getLogger("densify")
_progress = logging.getLogger("densify.progress")
_KEPT_IN_MEMORY = 16
_OPTIONS = {"seed": "0", "sensor": "hdl64", "hz": "10", "tilt": "0", "cameras": ",".join(USUAL)}


class Street:
    """The built-in street; members as in `LidarSequence`.

    preset: street, static (nothing else moves), crossing (the ego vehicle stands) or highway.
    seed: another number is another scene of that kind. sensor: a row of
    `densify.street.sensors.SENSORS`. hz: sweeps per second, 5, 10 or 20. The scene is the same at
    the same time: frame 120 at 10 Hz is frame 240 at 20 Hz. Scanners fire at a constant rate, so a
    spinning one has half the columns at 20 Hz. tilt_deg: pitch of the sensor's mount, nose down,
    -45 to 45; the cameras stay. cameras: names, none if empty. image_02 and image_03 expose once
    per sweep, the second 15 ms after its reference time. The others have clocks of their own: fast
    (30 Hz), rolling (a rolling shutter, 0.1 ms per row), fisheye (190 degrees, to the left).

    Raises InputError for a value that does not exist.
    """

    def __init__(
        self,
        preset: str = "street",
        seed: int = 0,
        sensor: str = "hdl64",
        hz: int = 10,
        tilt_deg: float = 0.0,
        cameras: tuple[str, ...] = USUAL,
    ) -> None:
        _check("preset", preset, PRESETS)
        _check("sensor", sensor, SENSORS)
        _check("hz", str(hz), ("5", "10", "20"))
        if seed < 0:
            raise InputError(f"street seed {seed}: expected a whole number from 0")
        if not abs(tilt_deg) <= 45:
            raise InputError(f"street tilt {tilt_deg:g}: expected degrees from -45 to 45")
        for name in cameras:
            _check("camera", name, CAMERAS)
        changed = [("hz", hz)] * (hz != 10) + [("tilt", f"{tilt_deg:g}")] * (tilt_deg != 0)
        options = "".join(f"&{key}={value}" for key, value in changed)
        shown = f"&cameras={','.join(cameras) or 'none'}" * (cameras != USUAL)
        self.name = f"street:{preset}?seed={seed}&sensor={sensor}{options}{shown}"
        self.simulator = Simulator(preset, seed, SENSORS[sensor], hz, tilt_deg)
        self.frames = range(self.simulator.num_frames)
        self.cameras: Mapping[str, Camera] = cameras_beside(tilt_deg, cameras)
        self.truth = StreetTruth(self)
        self._store = _Store()
        self._posed = _digest(f"{VERSION} {preset} {seed}{options}, with any sensor")
        self._swept = _digest(f"{VERSION} {preset} {seed} {sensor}{options}")
        self._pictured = _digest(f"{VERSION} {preset} {seed} {hz} Hz, with any sensor")

    @staticmethod
    def from_spec(spec: str) -> Street:
        """Parse ``street``, ``street:highway``, ``street:crossing?seed=2&sensor=vlp16`` and so on.
        Raises InputError for anything else."""
        head, _, query = spec.partition("?")
        reader, _, preset = head.partition(":")
        if reader != "street":
            raise InputError(
                f"{spec!r}: expected street[:PRESET][?seed=N&sensor=NAME&hz=RATE&tilt=DEG"
                f"&cameras=NAME,NAME]"
            )
        given = parse_qsl(query, keep_blank_values=True)
        for key, _ in given:
            _check("option", key, _OPTIONS)
        options = _OPTIONS | dict(given)
        if len(dict(given)) < len(given):
            raise InputError(f"{spec!r}: an option is given twice; keep one of each")
        seed, tilt, cameras = options["seed"], options["tilt"], options["cameras"]
        if not (seed.isascii() and seed.isdigit() and len(seed) <= 18):
            raise InputError(
                f"street seed {seed!r}: expected a whole number from 0, of up to 18 digits, as in "
                f"street?seed=7"
            )
        _check("hz", options["hz"], ("5", "10", "20"))
        try:
            tilt_deg = float(tilt)
        except ValueError:
            raise InputError(
                f"street tilt {tilt!r}: expected degrees, nose down, as in street?tilt=10"
            ) from None
        names = () if cameras == "none" else tuple(cameras.split(","))
        hz = int(options["hz"])
        return Street(preset or "street", int(seed), options["sensor"], hz, tilt_deg, names)

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
            radial_velocity_m_s=returns.radial_velocity_m_s,
        )

    def keep_nothing(self) -> None:
        """Leave the cache folder alone from now on: nobody will ask for this street again."""
        self._store.on_disk = False

    def stamp_ns(self, frame: int) -> int:
        """Return the reference time of a sweep."""
        self.check(frame)
        return self.simulator.stamp_ns(frame)

    def returns(self, frame: int) -> Returns:
        """Return the sweep's returns with the bodies they are from."""
        self.check(frame)

        def make() -> dict[str, NDArray[Any]]:
            found = vars(self.simulator.returns(frame))
            return {name: array for name, array in found.items() if array is not None}

        return Returns(**self._store.get(f"{self._swept}/sweep/{frame}", make))

    def prepare(self, frames: Sequence[int], images: Sequence[tuple[str, int]] = ()) -> None:
        """Render what is not in the cache yet, on all cores."""
        wanted: dict[str, Callable[[], object]] = {
            **{f"{self._pictured}/{c}/{n}": partial(self.picture, c, n) for c, n in images},
            **{f"{self._swept}/sweep/{frame}": partial(self.returns, frame) for frame in frames},
        }
        missing = [make for name, make in wanted.items() if name not in self._store]
        if missing:
            _ = self.simulator.scene.world.triangles  # otherwise each thread might make them
            with ThreadPoolExecutor(num_threads()) as pool:
                for made in [pool.submit(make) for make in missing]:
                    made.result()

    def picture(self, camera: str, number: int) -> Picture:
        """Return a camera's image with its exact depth and the bodies in it."""
        stamps_ns = self.image_stamps_ns(camera)
        if number not in stamps_ns:
            raise InputError(
                f"street: no image {number} of {camera}; there are images 0 to {max(stamps_ns)}"
            )
        name = f"{self._pictured}/{camera}/{number}"
        make = partial(self.simulator.picture, camera, number)
        return Picture(**self._store.get(name, lambda: vars(make())))

    def image(self, camera: str, number: int) -> NDArray[np.uint8]:
        """Return (H,W,3) RGB."""
        return self.picture(camera, number).image

    def image_stamps_ns(self, camera: str) -> Mapping[int, int]:
        """Return when the camera exposes, by the image's number from 0."""
        _check("camera", camera, self.cameras)
        return self.simulator.image_stamps_ns(camera)

    @cached_property
    def bodies(self) -> Bodies:
        """The poses of every body at every frame's reference time."""
        name = f"{self._posed}/bodies"
        return Bodies(**self._store.get(name, lambda: vars(self.simulator.bodies), is_frame=False))

    def T_world_lidar(self, frame: int) -> Float:
        """Return the true (4,4) pose at the sweep's reference time."""
        self.check(frame)
        return self.bodies.T_world_lidar[frame]

    def check(self, frame: int) -> None:
        """Raise InputError for a frame that does not exist."""
        if frame not in self.frames:
            raise InputError(f"street: no frame {frame}; there are frames 0 to {self.frames[-1]}")


class StreetTruth:
    """Exact truth of a street; members as in `Truth`."""

    def __init__(self, street: Street) -> None:
        self._street = street

    def sweep(self, frame: int) -> SweepTruth:
        """Return the truth. Its points are the raw points at the reference time, each moved with
        its body."""
        returns = self._street.returns(frame)
        points = self._street.simulator.in_bodies(frame, returns)
        return self._street.bodies.sweep(frame, returns.body, returns.instance, points)

    def displacement(self, frame: int, target: int) -> Float:
        """Return (N,3), exactly 0 for what is static between the two frames."""
        self._street.check(target)
        returns = self._street.returns(frame)
        points = self._street.simulator.in_bodies(frame, returns)
        return self._street.bodies.displacement(frame, target, returns.body, points)

    def depth_m(self, camera: str, number: int) -> Float32:
        return self._street.picture(camera, number).depth_m

    def moving_mask(self, camera: str, number: int) -> Bool:
        body = self._street.picture(camera, number).body
        simulator, frames = self._street.simulator, self._street.frames
        since_ns = simulator.image_stamps_ns(camera)[number] - simulator.stamp_ns(0)
        frame = min(max(round(since_ns / simulator.period_ns), 0), frames[-1])
        moving: Bool = (body >= 0) & self._street.bodies.moving[frame][body]
        return moving


def _check(what: str, got: str, known: Sequence[str] | Mapping[str, Any]) -> None:
    if got not in known:
        raise InputError(f"street: no {what} {got!r}; there are {', '.join(known)}")


def _digest(identity: str) -> str:
    return hashlib.sha256(identity.encode()).hexdigest()[:16]


class _Store:
    """Arrays by name, some in memory and all in the cache folder, which processes share. A file
    that cannot be read is made again; a folder that cannot be written only costs time."""

    def __init__(self) -> None:
        self._folder = own_folder("street")
        self._memory: OrderedDict[str, dict[str, NDArray[Any]]] = OrderedDict()
        self._lock = threading.Lock()
        self._announced = False
        self.on_disk = True

    def __contains__(self, name: str) -> bool:
        in_folder = self.on_disk and (self._folder / f"{name}.npz").exists()
        return name in self._memory or in_folder

    def get(
        self, name: str, make: Callable[[], dict[str, NDArray[Any]]], is_frame: bool = True
    ) -> dict[str, NDArray[Any]]:
        """Return the arrays. Threads may ask for different names. is_frame: making it takes long,
        which is said before the first."""
        with self._lock:
            arrays = self._memory.pop(name, None)
        if arrays is None:
            arrays = self._read_or_make(name, make, is_frame)
        with self._lock:
            self._memory[name] = arrays
            if len(self._memory) > _KEPT_IN_MEMORY:
                self._memory.popitem(last=False)
        return arrays

    def _read_or_make(
        self, name: str, make: Callable[[], dict[str, NDArray[Any]]], is_frame: bool
    ) -> dict[str, NDArray[Any]]:
        if not self.on_disk:
            return make()
        path = self._folder / f"{name}.npz"
        try:
            return read_arrays(path)
        except InputError:
            pass  # not there, or damaged
        if is_frame and not self._announced:
            self._announced = True
            _progress.info("rendering the street, 1 to 2 s a sweep; kept in %s", self._folder)
        arrays = make()
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            save_arrays(path, arrays)
        except OSError as error:
            _log.debug("street frame not kept in the cache: %s", error)
        return arrays
