# SPDX-License-Identifier: MIT
"""A training set of `densify dataset --layout kitti-depth`, read back as a torch dataset. Images
come from the recordings it was made of."""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch.utils.data import Dataset

from densify.config.errors import InputError
from densify.dataset.manifest import read_manifests
from densify.dataset.plan import StoredDrive, read_plan, stored_drives
from densify.depth.exposure import key_shots
from densify.geometry.types import Camera, Float, Float32, LidarSequence
from densify.outputs.depth_png import read_depth_png, read_stored
from densify.readers import open_sequence

LAYOUT = "kitti-depth"
_MOST_CERTAIN, _LEAST_CERTAIN = 255, 1  # as stored; 0 is no depth


class _Sample(NamedTuple):
    drive: str
    camera: str
    frame: int


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
    recording that is not rectified, ``intrinsics`` leave the lens's distortion out.

    Each process opens recordings when it first needs them, so the set can be handed to the workers
    of a DataLoader. Seed, epoch and index alone decide what is random.
    """

    def __init__(
        self,
        root: str | Path,
        cameras: Sequence[str] | None = None,
        filled: bool = False,
        crop: tuple[int, int] | None = None,
        flip: bool = False,
        seed: int = 0,
        data: Mapping[str, str | Path] | None = None,
        split: Literal["train", "val"] | None = None,
    ) -> None:
        """root: ``--out`` of `densify dataset`.
        cameras: names, all if None.
        filled: dense depth has the pixels interpolated between measured ones too.
        crop: (height_px, width_px), cut out at the bottom of the image, where the depth is, and at
            a random place from left to right.
        flip: mirror every other sample, at random.
        seed: from 0; see `set_epoch`.
        data: drive -> where its recording is now, for `densify.open_sequence`; needed for those
            that have moved since the set was made.
        split: "train" or "val", KITTI's; both if None.

        Raises InputError if there is no set of this layout, nothing in it is left to load, or a
        crop is larger than an image; loading raises it for files that are missing or damaged.
        """
        self._root = Path(root)
        self._filled, self._crop, self._flip, self._seed = filled, crop, flip, seed
        self._drives = _read_drives(self._root)
        self._specs = {name: drive.data for name, drive in self._drives.items()}
        self._specs |= {name: str(spec) for name, spec in (data or {}).items()}
        self._samples = self._find_samples(cameras, split)
        self._check_crop()
        # Shared: workers that live on from epoch to epoch see it change.
        self._epoch = torch.zeros((), dtype=torch.int64).share_memory_()
        self._opened: dict[tuple[int, str], LidarSequence] = {}

    def set_epoch(self, epoch: int) -> None:
        """Draw new crops and flips: call it before each epoch with its number, from 0."""
        self._epoch.fill_(epoch)

    def __len__(self) -> int:
        return len(self._samples)

    def __getitem__(self, index: int) -> dict[str, Any]:
        """Return the sample; see the class. Raises InputError for what is missing or damaged."""
        sample = self._samples[index]
        camera = self._drives[sample.drive].cameras[sample.camera]
        maps = self._read_maps(sample, camera)
        maps["image"] = self._read_image(sample, camera)
        rows, columns, mirrored = self._view(camera, index % len(self))
        step = -1 if mirrored else 1
        tensors = {
            name: torch.from_numpy(np.ascontiguousarray(array[..., rows, columns][..., ::step]))
            for name, array in maps.items()
        }
        tensors["image"] = tensors["image"].to(torch.float32).div_(255)
        K = _viewed_K(camera.K, rows.start, columns, mirrored)
        return {
            **tensors,
            "intrinsics": torch.from_numpy(K.astype(np.float32)),
            **sample._asdict(),
        }

    def __getstate__(self) -> dict[str, Any]:
        return {**self.__dict__, "_opened": {}}

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__dict__.update(state)
        self._epoch.share_memory_()

    def _find_samples(self, cameras: Sequence[str] | None, split: str | None) -> list[_Sample]:
        done = [r for r in read_manifests(self._root).values() if r.status == "done"]
        samples = [
            _Sample(record.drive, camera, record.key)
            for record in done
            if (drive := self._drives.get(record.drive)) is not None
            if split is None or drive.folder.startswith(f"{split}/")
            for camera in drive.cameras
            if cameras is None or camera in cameras
            if _map_path(drive, "groundtruth", camera, record.key) in record.files
        ]
        if not samples:
            there = sorted({name for drive in self._drives.values() for name in drive.cameras})
            raise InputError(
                f"{self._root}: nothing to load: of {len(done)} finished keys in manifest*.jsonl, "
                f"expected one of split {split} and cameras {cameras}, None for all; there are the "
                f"cameras {', '.join(there)}; let densify dataset finish some"
            )
        return sorted(samples)

    def _check_crop(self) -> None:
        height_px, width_px = self._crop or (1, 1)
        for name, camera in sorted({(s.drive, s.camera) for s in self._samples}):
            size = self._drives[name].cameras[camera]
            if not (0 < height_px <= size.height_px and 0 < width_px <= size.width_px):
                raise InputError(
                    f"crop: got {height_px} x {width_px} px (height x width), expected at most "
                    f"the {size.height_px} x {size.width_px} of {camera} in {name}"
                )

    def _read_maps(self, sample: _Sample, camera: Camera) -> dict[str, NDArray[Any]]:
        """Return the maps, (1,H,W) each."""

        def read(kind: str, reader: Callable[[Path], NDArray[Any]]) -> NDArray[Any]:
            drive = self._drives[sample.drive]
            path = self._root / _map_path(drive, kind, sample.camera, sample.frame)
            try:
                stored = reader(path)
                _check_size(str(path), stored, camera)
            except InputError as error:
                raise InputError(
                    f"{error}; run densify dataset again with --verify, as the set was made: it "
                    f"makes missing and damaged files in {self._root} anew"
                ) from None
            return stored[None]

        dense_m = read("groundtruth_filled" if self._filled else "groundtruth", read_depth_png)
        levels = read("confidence", lambda path: read_stored(path, np.uint8, "a confidence map"))
        return {
            "sparse_depth_m": read("velodyne_raw", read_depth_png),
            "dense_depth_m": dense_m,
            "confidence": _confidence(levels, dense_m),
        }

    def _read_image(self, sample: _Sample, camera: Camera) -> NDArray[np.uint8]:
        """Return the image, (3,H,W)."""
        recording = self._recording(sample.drive)
        where = f"{self._specs[sample.drive]}: {sample.camera} of frame {sample.frame}"
        number = key_shots(recording, [camera], sample.frame)[sample.camera].number
        if number is None:
            raise InputError(f"{where}: the recording has no image near that sweep")
        image = recording.image(sample.camera, number)
        _check_size(where, image, camera)
        return image.transpose(2, 0, 1)

    def _recording(self, drive: str) -> LidarSequence:
        here = (os.getpid(), drive)  # a forked worker opens its own
        if here not in self._opened:
            try:
                self._opened[here] = open_sequence(self._specs[drive])
            except InputError as error:
                raise InputError(
                    f"{self._root}: drive {drive}: {error}; if the recording has moved, give "
                    f"data={{{drive!r}: where it is now}}"
                ) from None
        return self._opened[here]

    def _view(self, camera: Camera, index: int) -> tuple[slice, slice, bool]:
        """Return the rows and columns that are cut out, and whether they are mirrored."""
        height_px, width_px = self._crop or (camera.height_px, camera.width_px)
        random = np.random.default_rng([self._seed, int(self._epoch), index])
        left = int(random.integers(camera.width_px - width_px + 1))
        mirrored = bool(random.integers(2)) and self._flip
        rows = slice(camera.height_px - height_px, camera.height_px)
        return rows, slice(left, left + width_px), mirrored


def _read_drives(root: Path) -> dict[str, StoredDrive]:
    table = read_plan(root)
    wanted = f"expected a set that densify dataset --layout {LAYOUT} made"
    if table is None:
        raise InputError(f"{root / 'dataset.json'}: no such file; {wanted}")
    if table["layout"] != LAYOUT:
        raise InputError(f"{root / 'dataset.json'}: got layout {table['layout']!r}; {wanted}")
    return stored_drives(table)


def _map_path(drive: StoredDrive, kind: str, camera: str, frame: int) -> str:
    """Return the map's path in the set, as the manifest names it."""
    return f"{drive.folder}/proj_depth/{kind}/{camera}/{frame:010d}.png"


def _check_size(where: str, image: NDArray[Any], camera: Camera) -> None:
    height_px, width_px = image.shape[:2]
    if (height_px, width_px) != (camera.height_px, camera.width_px):
        raise InputError(
            f"{where}: got {width_px} x {height_px} px, expected {camera.width_px} x "
            f"{camera.height_px} as dataset.json says"
        )


def _confidence(levels: NDArray[np.uint8], depth_m: Float32) -> Float32:
    """Return 0 to 1, of what `densify.outputs.depth_png.stored_confidence` gave."""
    known = (levels > 0) & (depth_m > 0)
    scale = np.float32(1 / (_MOST_CERTAIN - _LEAST_CERTAIN))
    return np.where(known, (levels.astype(np.float32) - _LEAST_CERTAIN) * scale, np.float32(0))


def _viewed_K(K: Float, top: int, columns: slice, mirrored: bool) -> Float:
    """Return K (3,3) after the crop and then the flip, which takes pixel u to width - 1 - u."""
    viewed = K.copy()
    viewed[:2, 2] -= columns.start, top
    if mirrored:
        viewed[0, 1] = -viewed[0, 1]
        viewed[0, 2] = columns.stop - columns.start - 1 - viewed[0, 2]
    return viewed
