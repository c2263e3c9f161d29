# SPDX-License-Identifier: MIT
"""Train a small network that completes the depth of a single sweep, guided by the image.

The network is a U-Net (Ronneberger, Fischer, Brox, MICCAI 2015) on sparse depth and image (Ma and
Karaman, "Sparse-to-Dense", ICRA 2018). Every camera is reduced to a focal length of 500 px, so that
one network serves several cameras. The same seed gives the same bytes on CPUs of one kind.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from itertools import pairwise
from typing import NamedTuple

import cv2
import numpy as np
import torch
from torch import Tensor, nn
from torch.nn.functional import grid_sample, interpolate

from densify.config.errors import InputError
from densify.flow.energy import on_one_thread
from densify.geometry.types import Bool, Float32
from densify.learning.training import find_device

_FOCAL_PX = 500.0
_CROP_PX = (112, 176)  # height, width
_WARM_UP = 0.1  # share of the steps before the greatest learning rate
_LARGEST_GRADIENT = 1.0  # norm of the gradient; a greater one is scaled down
_NUM_COMPARED = 4096  # pixels of a crop on which the loss is taken
_MOST_TARGETS = 60_000  # pixels of an image that are kept to train on
_INPUT_SHARE = 0.8  # share of the returns that are input, if the others are held out to train on
_USUAL_LOG_M = 2.7  # log depth (15 m) of an image without any return
_NONE = 99.0  # log depth of a pixel without a return
_NEIGHBOURHOODS_PX = (9, 21)  # sides of the squares with the nearest and the farthest return
_SQUARES_PX = (1, 3, 5, 7, 11, 17, 25, 37, 57, 87, 131)  # sides of the squares of the means
_STEEPNESS = (5.0, 2.0)  # the mean over a square is weighted by its side to minus this power


class Size(NamedTuple):
    """Size of a network, and how it is trained."""

    widths: tuple[int, ...]  # channels of the levels of the U-Net
    steps: int  # usual number of training steps
    batch: int  # crops of a step
    learning_rate: float  # greatest rate


SIZES = {
    "small": Size((16, 32, 48, 64, 64), steps=300, batch=2, learning_rate=2e-3),
    "large": Size((32, 64, 96, 144, 192), steps=1500, batch=8, learning_rate=1e-3),
}
"""Name of a size -> a network of 0.24 million weights for a CPU, or of 1.2 million for a GPU."""


class Sample(NamedTuple):
    """An image with a sparse depth, and depths to train on, reduced to the common focal length."""

    image: Float32  # (3,h,w) RGB with mean 0 and standard deviation 1
    returns: Float32  # (R,3) column, row in px of the reduced image, 0 at its corner; depth in m
    # (T,4) as ``returns``, and weight; None to hold out returns at random
    target: Float32 | None
    shape: tuple[int, int]  # (H,W) of the original image

    @staticmethod
    def of(
        image: Float32,
        sparse_m: Float32,
        target_m: Float32 | None = None,
        weight: Float32 | None = None,
        *,
        focal_px: float,
    ) -> Sample:
        """Make a sample from an image and its depth maps, such as those of `densify.DepthDataset`.

        Args:
            image: (3,H,W) RGB, 0 to 1.
            sparse_m: (H,W) depth of the single sweep in metres, 0 for none.
            target_m: (H,W) depth to train on in metres, 0 for none. None trains on a fifth of the
                sweep's pixels, which are held out anew at every step.
            weight: (H,W) weight of each target in the loss, such as its confidence; None for 1.
            focal_px: Focal length fx of the image in pixels.
        """
        shape = sparse_m.shape[0], sparse_m.shape[1]
        scale = min(1.0, _FOCAL_PX / focal_px)
        height, width = (max(1, round(scale * size)) for size in shape)
        small = cv2.resize(image.transpose(1, 2, 0), (width, height), interpolation=cv2.INTER_AREA)
        target = None
        if target_m is not None:
            weights = np.ones(shape, np.float32) if weight is None else weight
            target = _list_pixels(target_m, weights, width, height)
            if len(target) > _MOST_TARGETS:
                target = target[np.random.default_rng(0).permutation(len(target))[:_MOST_TARGETS]]
        returns = _list_pixels(sparse_m, sparse_m, width, height)[:, :3]
        # 1e-3 avoids a division by 0 in an image of one colour.
        small = (small - small.mean((0, 1))) / (small.std() + np.float32(1e-3))
        return Sample(np.ascontiguousarray(small.transpose(2, 0, 1)), returns, target, shape)


def _list_pixels(depth_m: Float32, weight: Float32, width: int, height: int) -> Float32:
    """Return the (N,4) pixels with a depth: column and row in the reduced image, depth, weight."""
    row, column = np.nonzero((depth_m > 0) & (weight > 0))
    x = (column + 0.5) * (width / depth_m.shape[1])
    y = (row + 0.5) * (height / depth_m.shape[0])
    return np.stack([x, y, depth_m[row, column], weight[row, column]], 1).astype(np.float32)


class Completion(nn.Module):
    """A U-Net that averages six depths of each pixel by learned weights, and adds a correction.

    The six depths are two weighted means of the returns around the pixel, and the nearest and the
    farthest return in each of two squares. An untrained network gives the first depth most weight.
    """

    def __init__(self, with_returns: bool = True, size: str = "small") -> None:
        """Make a network of a size of `SIZES`; without returns, its input is the image alone."""
        super().__init__()
        self.with_returns = with_returns
        widths = SIZES[size].widths
        levels = list(pairwise(widths))
        num_choices = 2 + 2 * len(_NEIGHBOURHOODS_PX)
        self._first = _convolution(3 + num_choices + 1, widths[0], 2)
        self._down = nn.ModuleList(_convolution(a, b, 2) for a, b in levels)
        self._up = nn.ModuleList(_convolution(b + a, a) for a, b in levels)
        self._last = nn.Conv2d(widths[0], num_choices + 1, 3, 1, 1)
        nn.init.zeros_(self._last.weight)
        with torch.no_grad():
            self._last.bias.copy_(torch.tensor([2.0] + num_choices * [0.0]))  # type: ignore[union-attr]

    def forward(self, image: Tensor, log_depths: Tensor) -> Tensor:
        """Return the log depth (N,1,h,w) for images (N,3,h,w) and `_log_depths` (N,7,h,w)."""
        # The network sees the first depth, and the differences of the other depths from it.
        choices, base = log_depths[:, :-1], log_depths[:, :1]
        inputs = [image, base - _USUAL_LOG_M, choices[:, 1:] - base, log_depths[:, -1:]]
        x = self._first(torch.cat(inputs, 1).contiguous(memory_format=torch.channels_last))
        skips = []
        for down in self._down:
            skips.append(x)
            x = down(x)
        for up, skip in zip(reversed(self._up), reversed(skips), strict=True):
            x = up(torch.cat([interpolate(x, skip.shape[2:]), skip], 1))
        x = interpolate(self._last(x), image.shape[2:], mode="bilinear")
        return (x[:, :-1].softmax(1) * choices).sum(1, keepdim=True) + x[:, -1:]


def _convolution(inputs: int, outputs: int, stride: int = 1) -> nn.Sequential:
    """Return a layer of a 3 x 3 convolution and its activation."""
    layer = nn.Conv2d(inputs, outputs, 3, stride, 1)
    nn.init.kaiming_normal_(layer.weight, 0.1)
    return nn.Sequential(layer, nn.LeakyReLU(0.1))


def _log_depths(returns: Float32, shape: tuple[int, ...], with_returns: bool) -> Float32:
    """Return the (7,h,w) input of a `Completion`: six log depths, and 1 at pixels with a return."""
    if not with_returns:
        returns = np.zeros((0, 3), np.float32)
    nearest = np.full(shape, _NONE, np.float32)
    column, row = returns[:, :2].astype(int).T
    np.minimum.at(nearest, (row, column), np.log(returns[:, 2]))
    has_return = (nearest < _NONE).astype(np.float32)
    inverse = has_return * np.exp(-nearest)  # linear over a plane, unlike depth
    layers = [_interpolated(inverse, has_return, steepness) for steepness in _STEEPNESS]
    for size in _NEIGHBOURHOODS_PX:
        square = np.ones((size, size), np.uint8)
        low = cv2.erode(nearest, square)
        high = -cv2.erode(np.where(has_return > 0, -nearest, np.float32(_NONE)), square)
        layers += [np.where(low < _NONE, low, layers[0]), np.where(high > -_NONE, high, layers[0])]
    return np.stack([*layers, has_return]).astype(np.float32)


def _interpolated(inverse: Float32, has_return: Float32, steepness: float) -> Float32:
    """Return the log (h,w) of a distance-weighted mean depth of the returns around each pixel."""
    # Inverse depths are averaged over squares of growing side s, with weights s^-steepness. Without
    # any return, 1e-12 gives the usual depth.
    total = np.full(inverse.shape, 1e-12 * np.exp(-_USUAL_LOG_M), np.float32)
    weight = np.full(inverse.shape, 1e-12, np.float32)
    for size in _SQUARES_PX:
        share = size**-steepness
        total += share * cv2.blur(inverse, (size, size))
        weight += share * cv2.blur(has_return, (size, size))
    return np.log(weight / total)


def train(
    samples: Sequence[Sample],
    steps: int | None = None,
    seed: int = 0,
    *,
    with_returns: bool = True,
    size: str = "small",
    device: str = "auto",
    progress: Callable[[int], None] | None = None,
) -> Completion:
    """Train a network by Adam on crops, with the mean absolute error of the log depth as loss.

    Networks of one seed start from the same weights and see the same crops in the same order.

    Args:
        samples: Samples to train on.
        steps: Number of training steps; None takes that of the size.
        seed: Seed of weights, order, crops and flips.
        with_returns: False trains on the image alone (monocular depth).
        size: Size of the network, a name in `SIZES`.
        device: "cpu", "cuda", or "auto" (CUDA if there is one).
        progress: Function called with the number of finished steps.
    """
    plan = SIZES[size]
    steps = plan.steps if steps is None else steps
    if not samples or steps < 1:
        raise InputError(f"got {len(samples)} samples and {steps} steps, expected 1 or more")
    torch.manual_seed(seed)
    torch_device = find_device(device)
    network = Completion(with_returns, size).train()
    network = network.to(device=torch_device, memory_format=torch.channels_last)  # type: ignore[call-overload]
    optimiser = torch.optim.Adam(network.parameters())
    num_steps = max(steps, 3)  # the learning rate rises for two steps at least, and falls for one
    rise = max(_WARM_UP, 2 / num_steps)
    schedule = torch.optim.lr_scheduler.OneCycleLR(
        optimiser, plan.learning_rate, total_steps=num_steps, pct_start=rise
    )
    image_sizes = np.array([sample.image.shape[1:] for sample in samples])
    height, width = np.minimum(_CROP_PX, image_sizes.min(0)).tolist()
    with on_one_thread():
        for step in range(steps):
            rng = np.random.default_rng([seed, step])
            rows = rng.choice(len(samples), plan.batch, replace=len(samples) < plan.batch)
            crops = [_crop(samples[row], (height, width), with_returns, rng) for row in rows]
            image, log_depths, position, target = (
                torch.from_numpy(np.stack(arrays)).to(torch_device)
                for arrays in zip(*crops, strict=True)
            )
            log_m = grid_sample(network(image, log_depths), position[:, None], align_corners=False)
            true_m, weight = target.unbind(-1)
            error = (log_m[:, 0, 0] - true_m.log()).abs()
            loss = (weight * error).sum() / weight.sum().clamp(min=1e-9)
            optimiser.zero_grad()
            loss.backward()
            nn.utils.clip_grad_norm_(network.parameters(), _LARGEST_GRADIENT)
            optimiser.step()
            schedule.step()
            if progress is not None:
                progress(step + 1)
    return network.train(False)


def _crop(
    sample: Sample, size: tuple[int, int], with_returns: bool, rng: np.random.Generator
) -> tuple[Float32, Float32, Float32, Float32]:
    """Return a random crop of a size (h,w), mirrored half the time.

    In order: image (3,h,w), `_log_depths` (7,h,w), positions (N,2) of targets in the crop from -1
    to 1, and targets (N,2), which are depth (m) and weight.
    """
    image_px = sample.image.shape[1:]
    height, width = size
    top = int(rng.integers(image_px[0] - height + 1))
    left = int(rng.integers(image_px[1] - width + 1))
    is_mirrored = rng.random() < 0.5
    returns, target = sample.returns, sample.target
    if target is None:
        is_input = rng.random(len(returns)) < _INPUT_SHARE
        target = np.column_stack([returns[~is_input], np.ones((~is_input).sum(), np.float32)])
        returns = returns[is_input]
    corner, extent = np.array((left, top), np.float32), np.array((width, height), np.float32)
    position = 2 * (target[:, :2] - corner) / extent - 1
    rows_inside = np.flatnonzero(_inside(position))
    if not len(rows_inside):  # no depth to compare with: a target of weight 0
        position, rows_inside = np.zeros((1, 2), np.float32), np.zeros(1, int)
        target = np.array([[0, 0, 1, 0]], np.float32)
    rows = rows_inside[(rng.random(_NUM_COMPARED) * len(rows_inside)).astype(int)]
    returns = returns[_inside(2 * (returns[:, :2] - corner) / extent - 1)]
    log_depths = _log_depths(returns - (left, top, 0), size, with_returns)
    image, position = sample.image[:, top : top + height, left : left + width], position[rows]
    if is_mirrored:
        image, log_depths = image[..., ::-1], log_depths[..., ::-1]
        position = position * np.array((-1, 1), np.float32)
    return image.copy(), log_depths.copy(), position, target[rows, 2:]


def _inside(position: Float32) -> Bool:
    """Return the (N,) mask of positions (N,2) between -1 and 1."""
    column, row = position.T
    inside: Bool = (column > -1) & (column < 1) & (row > -1) & (row < 1)
    return inside


def predict(network: Completion, sample: Sample) -> Float32:
    """Return the depth (H,W) in metres that a network predicts for the original image."""
    log_depths = _log_depths(sample.returns, sample.image.shape[1:], network.with_returns)
    device = next(network.parameters()).device
    inputs = [torch.from_numpy(array)[None].to(device) for array in (sample.image, log_depths)]
    with torch.no_grad(), on_one_thread():
        log_m = interpolate(network(*inputs), sample.shape, mode="bilinear")
        depth_m: Float32 = log_m[0, 0].exp().cpu().numpy()
    return depth_m
