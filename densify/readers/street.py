# SPDX-License-Identifier: MIT
"""The built-in street as a recording: frames are made when asked for and kept in a cache folder.

``street[:PRESET][?seed=N&sensor=NAME]``. Frames 0 to 159, ten a second. The cache lies in the
user's cache directory, or in the folder named by the environment variable DENSIFY_CACHE_DIR; it can
be deleted at any time. A cached frame equals one made anew, byte for byte.
"""

from __future__ import annotations

import hashlib
import logging
import os
import threading
import zipfile
from collections import OrderedDict
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any
from urllib.parse import parse_qsl

import numpy as np
import platformdirs
from numpy.typing import NDArray

from densify.errors import InputError
from densify.street.camera import CAMERAS, DELAY_NS, Picture
from densify.street.casting import NUM_FRAMES
from densify.street.lidar import Returns
from densify.street.scenes import PRESETS
from densify.street.sensors import SENSORS, sensor_named
from densify.street.simulator import VERSION, Simulator, stamp_ns
from densify.types import Bool, Camera, Float, Float32, Sweep, SweepTruth

Arrays = dict[str, NDArray[Any]]
_log = logging.getLogger("densify")
_KEPT_IN_MEMORY = 16


class Street:
    """The built-in street; members as in `densify.types.LidarSequence`.

    preset: street, static (nothing else moves), crossing (the ego vehicle stands) or highway.
    seed: another number is another scene of that kind. sensor: hdl64, hdl32, vlp16, or dual32, two
    32-beam scanners half a turn apart.

    Raises InputError for a preset, sensor or seed that does not exist.
    """

    frames = range(NUM_FRAMES)
    cameras: Mapping[str, Camera] = CAMERAS

    def __init__(self, preset: str = "street", seed: int = 0, sensor: str = "hdl64") -> None:
        _choice("preset", preset, tuple(PRESETS))
        _choice("sensor", sensor, tuple(SENSORS))
        if seed < 0:
            raise InputError(f"street seed {seed}: expected a whole number from 0")
        self.name = f"street:{preset}?seed={seed}&sensor={sensor}"
        self.simulator = Simulator(preset, seed, sensor)
        self.truth = StreetTruth(self)
        self._store = _Store(f"{VERSION} {preset} {seed} {sensor}")

    @staticmethod
    def from_spec(spec: str) -> Street:
        """``street``, ``street:highway``, ``street:crossing?seed=2&sensor=vlp16`` and the like.

        Raises InputError for anything else.
        """
        head, _, query = spec.partition("?")
        reader, _, preset = head.partition(":")
        if reader != "street":
            raise InputError(f"{spec!r}: expected street[:PRESET][?seed=N&sensor=NAME]")
        options = dict(parse_qsl(query, keep_blank_values=True))
        for key in options:
            _choice("option", key, ("seed", "sensor"))
        seed = options.get("seed", "0")
        if not (seed.isascii() and seed.isdigit()):
            raise InputError(
                f"street seed {seed!r}: expected a whole number from 0, as in street?seed=7"
            )
        return Street(preset or "street", int(seed), options.get("sensor", "hdl64"))

    def __getitem__(self, frame: int) -> Sweep:
        returns = self.returns(frame)
        return Sweep(
            frame=frame,
            stamp_ns=stamp_ns(frame),
            points=returns.points.astype(np.float64),
            intensity=returns.intensity,
            offset_ns=returns.offset_ns,
            lidar=returns.lidar,
            row=np.arange(len(returns.points)),
            scanner_origins=sensor_named(self.simulator.sensor).origins_m,
        )

    def stamp_ns(self, frame: int) -> int:
        """Reference time of a sweep."""
        _check_frame(frame)
        return stamp_ns(frame)

    def returns(self, frame: int) -> Returns:
        """The sweep's returns with the bodies they are from."""
        _check_frame(frame)
        return Returns(
            **self._store.get(f"sweep/{frame}", lambda: vars(self.simulator.returns(frame)))
        )

    def picture(self, camera: str, frame: int) -> Picture:
        """A camera's image with its exact depth and the bodies seen."""
        _check_frame(frame)
        _choice("camera", camera, tuple(CAMERAS))
        return Picture(
            **self._store.get(
                f"{camera}/{frame}", lambda: vars(self.simulator.picture(camera, frame))
            )
        )

    def image(self, camera: str, frame: int) -> NDArray[np.uint8]:
        """(H,W,3) RGB."""
        return self.picture(camera, frame).image

    def image_stamp_ns(self, camera: str, frame: int) -> int:
        """image_02 is taken at the sweep's reference time, image_03 15 ms later."""
        _check_frame(frame)
        _choice("camera", camera, tuple(CAMERAS))
        return stamp_ns(frame) + DELAY_NS[camera]

    def T_world_lidar(self, frame: int) -> Float:
        """(4,4) true pose at the sweep's reference time."""
        _check_frame(frame)
        return self.simulator.bodies.T_world_lidar[frame]


class StreetTruth:
    """Exact truth of a street; members as in `densify.types.Truth`."""

    def __init__(self, street: Street) -> None:
        self._street = street

    def sweep(self, frame: int) -> SweepTruth:
        """points: where the measured raw points are at the reference time, each carried on by the
        body it belongs to."""
        returns = self._street.returns(frame)
        simulator = self._street.simulator
        points = simulator.in_bodies(frame, returns)
        return simulator.bodies.sweep(frame, returns.body, returns.instance, points)

    def displacement(self, frame: int, target: int) -> Float:
        """(N,3), exactly 0 for everything that stands still between the two frames."""
        _check_frame(target)
        returns = self._street.returns(frame)
        simulator = self._street.simulator
        points = simulator.in_bodies(frame, returns)
        return simulator.bodies.displacement(frame, target, returns.body, points)

    def depth_m(self, camera: str, frame: int) -> Float32:
        return self._street.picture(camera, frame).depth_m

    def moving_mask(self, camera: str, frame: int) -> Bool:
        body = self._street.picture(camera, frame).body
        moving: Bool = (body >= 0) & self._street.simulator.bodies.moving[frame][body]
        return moving


def _choice(what: str, got: str, there_are: tuple[str, ...]) -> None:
    if got not in there_are:
        raise InputError(f"street: no {what} {got!r}; there are {', '.join(there_are)}")


def _check_frame(frame: int) -> None:
    if not 0 <= frame < NUM_FRAMES:
        raise InputError(f"street: no frame {frame}; there are frames 0 to {NUM_FRAMES - 1}")


class _Store:
    """Arrays made once and then kept, a few in memory and all in the cache folder.

    Files are written aside and renamed, so that several processes can share the folder; a file
    that cannot be read is made anew; a folder that cannot be written only costs time.
    """

    def __init__(self, identity: str) -> None:
        root = os.environ.get("DENSIFY_CACHE_DIR") or platformdirs.user_cache_dir("densify")
        digest = hashlib.sha256(identity.encode()).hexdigest()[:16]
        self._folder = Path(root) / "street" / digest
        self._memory: OrderedDict[str, Arrays] = OrderedDict()

    def get(self, name: str, make: Callable[[], Arrays]) -> Arrays:
        if name not in self._memory:
            path = self._folder / f"{name}.npz"
            arrays = _read(path)
            if arrays is None:
                arrays = make()
                _write(path, arrays)
            self._memory[name] = arrays
            if len(self._memory) > _KEPT_IN_MEMORY:
                self._memory.popitem(last=False)
        self._memory.move_to_end(name)
        return self._memory[name]


def _read(path: Path) -> Arrays | None:
    try:
        with np.load(path) as arrays:
            return {name: arrays[name] for name in arrays.files}
    except (OSError, ValueError, EOFError, zipfile.BadZipFile):
        return None  # not there, or damaged: it is made anew


def _write(path: Path, arrays: Arrays) -> None:
    aside = path.with_name(f".{path.stem}.{os.getpid()}.{threading.get_ident()}.npz")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        try:
            with aside.open("wb") as file:
                np.savez(file, **arrays)  # type: ignore[arg-type]
            os.replace(aside, path)
        finally:
            aside.unlink(missing_ok=True)
    except OSError as error:
        _log.debug("street frame not kept in the cache: %s", error)
