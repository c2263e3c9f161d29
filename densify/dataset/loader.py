# SPDX-License-Identifier: MIT
"""Read a training set of `densify dataset --layout kitti-depth` as a torch dataset."""

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
from densify.depth.confidence import choose_most_certain
from densify.depth.exposure import key_shots
from densify.geometry.types import Camera, Float, LidarSequence
from densify.outputs.depth_png import read_depth_png, read_stored
from densify.readers import open_sequence


class DepthDataset(Dataset[dict[str, Any]]):
    """A dataset with a sample for each finished key sweep and camera.

    Samples are ordered by drive, camera and frame number. A sample is a dict of float32 tensors and
    names. H and W are the size after cropping::

        image           (3,H,W) RGB, 0 to 1, read from the recording
        sparse_depth_m  (1,H,W) camera z in metres from the key sweep alone, 0 for no depth
        dense_depth_m   (1,H,W) camera z in metres from all sweeps of the window, 0 for no depth
        confidence      (1,H,W) of the dense depth, 1 most certain; 0 at pixels without a depth
        intrinsics      (3,3) K in pixels of the cropped, flipped image; integers at pixel centres
        frame           int, frame number in the recording; drive, camera: str

    A flipped sample shows a mirrored world: camera x becomes -x, and focal lengths stay positive.
    ``intrinsics`` ignore lens distortion. `torch.manual_seed` repeats crops and flips, also in the
    workers of a DataLoader.
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
        max_outliers: float | None = None,
    ) -> None:
        """Find the finished key sweeps of a training set. Raise InputError if there are none.

        Args:
            root: Folder of the training set, ``--out`` of `densify dataset`.
            cameras: Names of the cameras, None for all.
            filled: Use the filled map (measured and interpolated pixels) as dense depth.
            crop: (height_px, width_px) of a cutout at the bottom of the image, where depth is, and
                at a random column.
            flip: Mirror each sample with probability 0.5.
            data: Drive -> new path of its recording, for `densify.open_sequence`, if it has moved
                since the set was made.
            split: KITTI's split, ``train`` or ``val``, None for both.
            max_outliers: Greatest expected share of outliers of a dense depth, 0.01 for 1 %. The
                least certain pixels are left out until it is reached. Pixels that are not in the
                set are not given back: make it with a ``project.max_outliers`` as high as any that
                is wanted. None leaves out none.
        """
        self._root, self._crop, self._flip = Path(root), crop, flip
        self._max_outliers = max_outliers
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
            known = sorted({name for drive in self._drives.values() for name in drive.cameras})
            raise InputError(
                f"{self._root}: nothing to load: no finished key in manifest*.jsonl of split "
                f"{split} and cameras {cameras}, None for all; there are the cameras "
                f"{', '.join(known)}; let densify dataset finish some"
            )

    def __repr__(self) -> str:
        drives = {drive for drive, *_ in self._samples}
        return f"DepthDataset({self._root}: {len(self)} samples of {len(drives)} recordings)"

    def __len__(self) -> int:
        return len(self._samples)

    def __getitem__(self, index: int) -> dict[str, Any]:
        drive, camera_name, frame = self._samples[index]
        camera = self._drives[drive].cameras[camera_name]
        maps, K = self._cut(self._maps(drive, camera, frame), camera, drive)
        tensors = {name: torch.from_numpy(array.copy()) for name, array in maps.items()}
        names = {"drive": drive, "camera": camera_name, "frame": frame}
        return {**tensors, "intrinsics": torch.from_numpy(K.astype(np.float32)), **names}

    def _maps(self, name: str, camera: Camera, frame: int) -> dict[str, NDArray[Any]]:
        """Return the image and the maps (channels,H,W) of a sample."""

        def read(kind: str, reader: Callable[[Path], NDArray[Any]]) -> NDArray[Any]:
            path = self._root / _map_path(self._drives[name], kind, camera.name, frame)
            try:
                return _of_size(camera, str(path), reader(path))[None]
            except InputError as error:
                raise InputError(
                    f"{error}; run densify dataset again with --verify, as the set was made: it "
                    f"makes missing and damaged files in {self._root} again"
                ) from None

        dense_m = read(self._dense, read_depth_png)
        stored = read("confidence", lambda path: read_stored(path, np.uint8, "a confidence map"))
        # Stored values 1 to 255 are confidence 0 to 1.
        confidence = np.where(dense_m > 0, (stored - np.float32(1)) / 254, np.float32(0)).clip(0)
        if self._max_outliers is not None:
            kept = dense_m > 0
            kept[kept] = choose_most_certain(confidence[kept], self._max_outliers)
            dense_m, confidence = dense_m * kept, confidence * kept
        return {
            "image": self._image(name, camera, frame).transpose(2, 0, 1) / np.float32(255),
            "sparse_depth_m": read("velodyne_raw", read_depth_png),
            "dense_depth_m": dense_m,
            "confidence": confidence,
        }

    def _cut(
        self, maps: Mapping[str, NDArray[Any]], camera: Camera, drive: str
    ) -> tuple[dict[str, NDArray[Any]], Float]:
        """Return the maps, cropped and flipped at random, and their intrinsics (3,3) in pixels."""
        height_px, width_px = self._crop or (camera.height_px, camera.width_px)
        if not (0 < height_px <= camera.height_px and 0 < width_px <= camera.width_px):
            raise InputError(
                f"crop: got {height_px} x {width_px} px (height x width), expected at most the "
                f"{camera.height_px} x {camera.width_px} of {camera.name} in {drive}"
            )
        top = camera.height_px - height_px
        left = int(torch.randint(camera.width_px - width_px + 1, ()))
        K = camera.K.copy()
        K[:2, 2] -= left, top
        step = -1 if self._flip and torch.randint(2, ()) else 1
        if step < 0:  # pixel u becomes width - 1 - u
            K[0, 1:] = -K[0, 1], width_px - 1 - K[0, 2]
        columns = slice(left, left + width_px)
        return {name: array[:, top:, columns][..., ::step] for name, array in maps.items()}, K

    def _image(self, drive: str, camera: Camera, frame: int) -> NDArray[np.uint8]:
        """Return the RGB image (H,W,3) of a camera at a key sweep."""
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
    """Open a recording once per process, because forked processes must not share open files."""
    return open_sequence(spec)


def _read_drives(root: Path) -> dict[str, Drive]:
    """Return the drives of a training set by name. Raise InputError for another folder."""
    table, wanted = read_plan(root), "expected a set that densify dataset --layout kitti-depth made"
    if table is None:
        raise InputError(f"{root / 'dataset.json'}: no such file; {wanted}")
    if table["layout"] != "kitti-depth":
        raise InputError(f"{root / 'dataset.json'}: got layout {table['layout']!r}; {wanted}")
    return drives_of(table)


def _map_path(drive: Drive, kind: str, camera: str, frame: int) -> str:
    """Return the path of a map relative to the training set, as named in the manifest."""
    return f"{drive.folder}/proj_depth/{kind}/{camera}/{frame:010d}.png"


def _of_size(camera: Camera, where: str, image: NDArray[Any]) -> NDArray[Any]:
    """Return the image. Raise InputError if its size differs from the camera's."""
    height_px, width_px = image.shape[:2]
    if (height_px, width_px) != (camera.height_px, camera.width_px):
        raise InputError(
            f"{where}: got {width_px} x {height_px} px, expected {camera.width_px} x "
            f"{camera.height_px} as dataset.json says"
        )
    return image
