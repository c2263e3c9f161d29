# SPDX-License-Identifier: MIT
"""Maps made with wrong images, beside those that listen to none (``project.rims=strict``)."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from densify.bench.depth import exact_truth
from densify.config import resolve
from densify.depth.exposure import key_shots, load_images
from densify.depth.image_alignment import lab
from densify.depth.views import HeldOut, SeenCloud, Views
from densify.free_space.range_image import RangeImage
from densify.geometry.types import DepthMap, Float32, LidarSequence
from densify.pipeline.recording import Recording
from densify.readers.window import choose_cameras
from densify.scores.depth_metrics import is_outlier_depth

Image = NDArray[np.uint8]


def moved(right_px: int, down_px: int) -> Callable[[Image], Image]:
    """Laid elsewhere; the border goes on."""

    def move(image: Image) -> Image:
        rows, columns = (
            np.clip(np.arange(size) - off, 0, size - 1)
            for size, off in zip(image.shape[:2], (down_px, right_px), strict=True)
        )
        return image[rows[:, None], columns]

    return move


def _blurred(px: float) -> Callable[[Image], Image]:
    return lambda image: ndimage.gaussian_filter(image, (px, px, 0))


def _dimmed(share: float) -> Callable[[Image], Image]:
    return lambda image: (image * share).astype(np.uint8)


def _noisy(image: Image) -> Image:
    noise = np.random.default_rng(0).normal(0, 15, image.shape)
    return (image + noise).clip(0, 255).astype(np.uint8)


def _noise(image: Image) -> Image:
    return np.random.default_rng(0).integers(0, 256, image.shape).astype(np.uint8)


FAULTS: Mapping[str, tuple[Callable[[Image], Image], ...]] = {
    "right": (lambda image: image,),
    "1, 2, 3, 5, 10 px to the right": tuple(moved(px, 0) for px in (1, 2, 3, 5, 10)),
    "2 px down, up": (moved(0, 2), moved(0, -2)),
    "blurred, 1, 2 px": (_blurred(1), _blurred(2)),
    "a quarter, a tenth as light": (_dimmed(0.25), _dimmed(0.1)),
    "noise added (15 of 255)": (_noisy,),
    "noise instead": (_noise,),
}


class Compared(NamedTuple):
    """wrong: filled pixels that are wrong, as a multiple of those of ``project.rims=strict``; None
    where the image was not listened to, so that the maps are the same. as_dense: the same among the
    most certain pixels, as many as strict has."""

    wrong: float | None
    as_dense: float | None

    def __str__(self) -> str:
        return "–" if self.wrong is None else f"{self.wrong:.2f} ({self.as_dense:.2f})"


def bench_images(
    sequence: LidarSequence, key: int, camera: str, window: int
) -> dict[str, list[Compared]]:
    """The key's map with the images of `FAULTS`, against exact truth, or else, the key held out,
    against its own returns. Also with the next frame's image, where there is one."""
    config = resolve(None)
    recording = Recording(sequence, config, window, [key])
    shots = key_shots(sequence, choose_cameras(sequence, [camera]), key, config.project)
    stretch, images = recording.window(key), load_images(sequence, shots)
    views = Views.of(sequence, stretch, key, RangeImage.of(stretch[key]), shots, images, config)
    cloud = recording.moment(key, all_sweeps=True, engine="").cloud
    seen, standing = views.see(cloud), recording.standing(key)
    if standing is not None:
        seen = seen.joined(views.far(*standing, stretch, standing_only=True))
    exact = exact_truth(sequence, stretch[key].sweep, key, [camera], config)
    held_out = None if exact else HeldOut.of(views, cloud)
    truth_m = (held_out.key_alone[camera] if held_out else exact[camera]).depth_m
    faults = {name: [fault(images[camera]) for fault in made] for name, made in FAULTS.items()}
    number = (shots[camera].number or 0) + 1
    if number in sequence.image_stamps_ns(camera):
        faults["the next frame's"] = [sequence.image(camera, number)]
    return compare_images(views, seen, held_out, camera, truth_m, faults)


def compare_images(
    views: Views,
    seen: SeenCloud,
    held_out: HeldOut | None,
    camera: str,
    truth_m: Float32,
    images: Mapping[str, list[Image]],
) -> dict[str, list[Compared]]:
    """Maps with each of these images. held_out: makes them, None for the key's own."""
    focal_px = views.exposures[camera].camera.focal_px

    def made(image: Image | None) -> DepthMap:
        settings = replace(views.settings, rims="strict") if image is None else views.settings
        pictures = {} if image is None else {camera: lab(image)}
        with_it = replace(views, settings=settings, lab=pictures)
        if held_out is None:
            return with_it.depth(seen)[camera]
        return replace(held_out, views=replace(with_it, key_image=None)).depth(seen, True)[camera]

    def wrong(maps: DepthMap, num: int | None = None) -> tuple[int, int]:
        """How many pixels with a truth, the ``num`` most certain, and how many are wrong."""
        known = np.flatnonzero((truth_m > 0) & (maps.filled_m > 0))
        known = known[np.argsort(-maps.confidence.flat[known], kind="stable")][:num]
        bad = is_outlier_depth(maps.filled_m.flat[known], truth_m.flat[known], focal_px)
        return len(known), int(bad.sum())

    strict = made(None)
    num, num_wrong = wrong(strict)

    def compared(image: Image) -> Compared:
        maps = made(image)
        if np.array_equal(maps.filled_m, strict.filled_m):
            return Compared(None, None)
        counts = wrong(maps)[1], wrong(maps, num)[1]
        return Compared(*(count / max(num_wrong, 1) for count in counts))

    return {name: [compared(image) for image in parts] for name, parts in images.items()}
