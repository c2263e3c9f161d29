# SPDX-License-Identifier: MIT
"""Whether one image lies where the depth discontinuities of one sweep are."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from densify.config import resolve
from densify.depth.exposure import Exposure, key_shots
from densify.depth.views import Views
from densify.pipeline.recording import Recording
from densify.readers import open_sequence
from densify.scores.edge_fit import is_off, silhouettes_of

KEY, CAMERA = 60, "image_02"


@pytest.fixture(scope="module")
def recording() -> Recording:
    sequence = open_sequence("street?seed=5&sensor=hdl64")
    return Recording(sequence, resolve(None, ["register.source=dataset"]), 1, [KEY])


@pytest.fixture(scope="module")
def scene(recording):
    """The camera at its exposure, the silhouettes of the sweep, and the image."""
    sequence, stretch = recording.sequence, recording.window(KEY)
    shot = key_shots(sequence, [sequence.cameras[CAMERA]], KEY)[CAMERA]
    exposure = Exposure.of(sequence, stretch, KEY, shot, recording.settings)
    camera = replace(exposure.camera, T_cam_lidar=exposure.T_cam_key)
    return camera, silhouettes_of(stretch[KEY].sweep), sequence.image(CAMERA, shot.number)


def test_an_image_that_lies_aside_is_off(scene) -> None:
    camera, silhouettes, image = scene
    for shift, off in (((0, 0), False), ((2, -2), False), ((12, 0), True), ((0, -12), True)):
        assert is_off(camera, silhouettes, np.roll(image, shift, (0, 1))) == off, shift


@pytest.mark.parametrize("shift_px", [0, 12])
def test_a_map_says_that_its_image_is_off_and_does_not_use_it(recording, scene, shift_px) -> None:
    sequence, stretch = recording.sequence, recording.window(KEY)
    shots = key_shots(sequence, [sequence.cameras[CAMERA]], KEY)
    images = {CAMERA: np.roll(scene[2], shift_px, 0)}
    views = Views.of(sequence, stretch, KEY, shots, images, recording.settings)
    maps = views.depth_maps(views.see(recording.moment(KEY, False, None).cloud))[CAMERA]
    assert (CAMERA in views.lab) == (shift_px == 0)
    said = ["image edges do not lie on depth discontinuities"] * (shift_px > 0)
    assert [warning.split(" (")[0] for warning in maps.warnings] == said


def test_chance_and_a_few_discontinuities_judge_nothing(scene) -> None:
    """Some discontinuities in an image of noise, and a few in an image that lies aside."""
    camera, silhouettes, image = scene
    noise = np.random.default_rng(0).integers(0, 255, image.shape).astype(np.uint8)
    cases = [(noise, slice(first, None, 20)) for first in range(20)]
    for picture, rows in (*cases, (np.roll(image, 12, 0), slice(None, None, 100))):
        some = type(silhouettes)(*(column[rows] for column in silhouettes))
        assert not is_off(camera, some, picture)
