# SPDX-License-Identifier: MIT
"""Read a training set of `densify dataset --layout kitti-depth` as a torch dataset.

Images come from the recordings of the set.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping, Sequence
from functools import cache
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch
from numpy.typing import NDArray
from torch.utils.data import Dataset

from densify.config.errors import InputError
from densify.dataset.manifest import read_manifests
from densify.dataset.plan import Drive, drives_of, read_plan
from densify.depth.exposure import key_shots
from densify.geometry.types import Camera, LidarSequence
from densify.outputs.depth_png import read_depth_png, read_stored
from densify.readers import open_sequence


class DepthDataset(Dataset[dict[str, Any]]):
    """One sample for each finished key and camera, ordered by drive, camera and frame.

    A sample is a dict of float32 tensors and their names; H and W as cropped::

        image           (3,H,W) RGB, 0 to 1
        sparse_depth_m  (1,H,W) camera z of the key sweep alone, metres, 0 none
        dense_depth_m   (1,H,W) of the accumulated sweeps, metres, 0 none
        confidence      (1,H,W) of the dense depth, 1 most certain; 0 where there is none
        intrinsics      (3,3) K in pixels, of the image as it is here; integers at pixel centres
        frame           int, absolute; drive, camera: str

    A flipped sample is a mirrored world: camera x becomes -x, the focal lengths stay positive. Of a
    recording that is not rectified, ``intrinsics`` leave the lens's distortion out. Crops and flips
    are drawn by torch's generator: `torch.manual_seed` repeats them, in a DataLoader's workers too.
    """

    def __init__(
        self,
        root: str | Path,
        cameras: Sequence[str] | None = None,
        filled: bool = False,
        crop: tuple[int, int] | None = None,
        flip: bool = False,
        data: Mapping[str, str | Path] | None = None,
        split: Literal["train", "val"] | None = None,
    ) -> None:
        """Find the finished keys of a set.

        Args:
            root: ``--out`` of `densify dataset`.
            cameras: Names; None for all.
            filled: Take the filled map as dense depth.
            crop: (height_px, width_px), cut out at the bottom of the image, where the depth is, and
                at a random place from left to right.
            flip: Mirror every other sample, at random.
            data: Drive -> where its recording is now, for `densify.open_sequence`. It is needed for
                those that have moved since the set was made.
            split: ``train`` or ``val``, KITTI's; None for both.

        Raises:
            InputError: There is no set of this layout, or no finished key in it. Loading raises it
                for a crop larger than an image, and for files that are missing or damaged.
        """
        self._root, self._crop, self._flip = Path(root), crop, flip
        self._dense = "groundtruth_filled" if filled else "groundtruth"
        self._drives = _read_drives(self._root)
        self._specs = {name: drive.data for name, drive in self._drives.items()}
        self._specs |= {name: str(spec) for name, spec in (data or {}).items()}
        self._samples = sorted(
            (record.drive, camera, record.key)
            for record in read_manifests(self._root).values()
            if record.status == "done" and (drive := self._drives.get(record.drive)) is not None
            if split is None or drive.folder.startswith(f"{split}/")
            for camera in drive.cameras
            if cameras is None or camera in cameras
            if _map_path(drive, "groundtruth", camera, record.key) in record.files
        )
        if not self._samples:
            there = sorted({name for drive in self._drives.values() for name in drive.cameras})
            raise InputError(
                f"{self._root}: nothing to load: no finished key in manifest*.jsonl of split "
                f"{split} and cameras {cameras}, None for all; there are the cameras "
                f"{', '.join(there)}; let densify dataset finish some"
            )

    def __len__(self) -> int:
        return len(self._samples)

    def __getitem__(self, index: int) -> dict[str, Any]:
        """Return a sample, see the class.

        Raises:
            InputError: A file is missing or damaged.
        """
        name, camera_name, frame = self._samples[index]
        drive = self._drives[name]
        camera, K = drive.cameras[camera_name], drive.cameras[camera_name].K.copy()

        def read(kind: str, reader: Callable[[Path], NDArray[Any]]) -> NDArray[Any]:
            path = self._root / _map_path(drive, kind, camera_name, frame)
            try:
                return _of_size(camera, str(path), reader(path))[None]
            except InputError as error:
                raise InputError(
                    f"{error}; run densify dataset again with --verify, as the set was made: it "
                    f"makes missing and damaged files in {self._root} again"
                ) from None

        dense_m = read(self._dense, read_depth_png)
        levels = read("confidence", lambda path: read_stored(path, np.uint8, "a confidence map"))
        maps = {
            "image": self._image(name, camera, frame).transpose(2, 0, 1) / np.float32(255),
            "sparse_depth_m": read("velodyne_raw", read_depth_png),
            "dense_depth_m": dense_m,
            # 1 to 255, as `densify.outputs.depth_png.stored_confidence` gives
            "confidence": np.where(dense_m > 0, (levels - np.float32(1)) / 254, 0).clip(0),
        }
        size_px = camera.height_px, camera.width_px
        height_px, width_px = self._crop or size_px
        if not (0 < height_px <= size_px[0] and 0 < width_px <= size_px[1]):
            raise InputError(
                f"crop: got {height_px} x {width_px} px (height x width), expected at most the "
                f"{size_px[0]} x {size_px[1]} of {camera.name} in {name}"
            )
        top, left = size_px[0] - height_px, int(torch.randint(size_px[1] - width_px + 1, ()))
        K[:2, 2] -= left, top
        step = -1 if self._flip and torch.randint(2, ()) else 1
        if step < 0:  # pixel u becomes width - 1 - u
            K[0, 1:] = -K[0, 1], width_px - 1 - K[0, 2]
        arrays = {n: array[:, top:, left : left + width_px] for n, array in maps.items()}
        return {
            **{n: torch.from_numpy(array[..., ::step].copy()) for n, array in arrays.items()},
            "intrinsics": torch.from_numpy(K.astype(np.float32)),
            **{"drive": name, "camera": camera_name, "frame": frame},
        }

    def _image(self, drive: str, camera: Camera, frame: int) -> NDArray[np.uint8]:
        """Return the image, (H,W,3)."""
        spec = self._specs[drive]
        try:
            recording = _open(spec, os.getpid())
        except InputError as error:
            raise InputError(
                f"{self._root}: drive {drive}: {error}; if the recording has moved, give "
                f"data={{{drive!r}: where it is now}}"
            ) from None
        where = f"{spec}: {camera.name} of frame {frame}"
        number = key_shots(recording, [camera], frame)[camera.name].number
        if number is None:
            raise InputError(f"{where}: the recording has no image near that sweep")
        return _of_size(camera, where, recording.image(camera.name, number))


@cache
def _open(spec: str, process: int) -> LidarSequence:
    """Open a recording; a forked process opens its own."""
    return open_sequence(spec)


def _read_drives(root: Path) -> dict[str, Drive]:
    table, wanted = read_plan(root), "expected a set that densify dataset --layout kitti-depth made"
    if table is None:
        raise InputError(f"{root / 'dataset.json'}: no such file; {wanted}")
    if table["layout"] != "kitti-depth":
        raise InputError(f"{root / 'dataset.json'}: got layout {table['layout']!r}; {wanted}")
    return drives_of(table)


def _map_path(drive: Drive, kind: str, camera: str, frame: int) -> str:
    """Return the map's path in the set, as the manifest names it."""
    return f"{drive.folder}/proj_depth/{kind}/{camera}/{frame:010d}.png"


def _of_size(camera: Camera, where: str, image: NDArray[Any]) -> NDArray[Any]:
    """Return the image. Raise InputError if its size is not that of the camera."""
    height_px, width_px = image.shape[:2]
    if (height_px, width_px) != (camera.height_px, camera.width_px):
        raise InputError(
            f"{where}: got {width_px} x {height_px} px, expected {camera.width_px} x "
            f"{camera.height_px} as dataset.json says"
        )
    return image
