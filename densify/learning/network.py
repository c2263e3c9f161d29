# SPDX-License-Identifier: MIT
"""A network for whole sweeps: points to a grid of pillars, a U-Net over it, and back to points.

It follows FastFlow3D (Jund et al., "Scalable Scene Flow from Point Clouds in the Real World", RA-L
2022) and DeFlow (Zhang et al., ICRA 2024) and is small enough for a CPU. The points of each sweep
are encoded one by one and averaged over the cells of a grid of 0.4 m. The grids of all sweeps go
through one U-Net, which can compare them. Each source point reads the result at its position,
joined to its own code, and two more layers give its flow.
"""

from __future__ import annotations

from itertools import pairwise

import torch
from torch import Tensor, nn
from torch.nn import functional

from densify.learning.clouds import NetworkCloud, Sweeps

CELL_M = 0.4
NUM_CELLS = 256
REACH_M = CELL_M * NUM_CELLS / 2
"""Points farther from the scanner along x or y have no flow."""
NUM_SWEEPS = 3
_NUM_POINT_FEATURES = 6
_WIDTH = 16
_WIDTHS = (32, 48, 64, 96)
_LARGEST_HEIGHT_M = 4.0


class Voxels(nn.Module):
    """The network, 0.5 million weights."""

    def __init__(self) -> None:
        super().__init__()
        self.encode = nn.Sequential(
            nn.Linear(_NUM_POINT_FEATURES, _WIDTH), nn.ReLU(), nn.Linear(_WIDTH, _WIDTH), nn.ReLU()
        )
        widths = (NUM_SWEEPS * (_WIDTH + 1), *_WIDTHS)
        self.down = nn.ModuleList(_Block(a, b, stride=2) for a, b in pairwise(widths))
        self.up = nn.ModuleList(
            _Block(a + b, b, stride=1) for a, b in zip(widths[:1:-1], widths[-2:0:-1], strict=True)
        )
        self.decode = nn.Sequential(
            nn.Linear(widths[1] + _WIDTH + 3, 48), nn.ReLU(), nn.Linear(48, 32), nn.ReLU(),
            nn.Linear(32, 3),
        )  # fmt: skip
        with torch.no_grad():  # to begin with little moves, as in the world
            self.decode[-1].weight.mul_(0.1)  # type: ignore[operator, union-attr]
            self.decode[-1].bias.zero_()  # type: ignore[operator, union-attr]

    def forward(self, sweeps: Sweeps) -> Tensor:
        """Return the flow (n,3) of the first sweep to the second, metres; 0 out of reach."""
        given = [*sweeps[:NUM_SWEEPS], *[None] * (NUM_SWEEPS - len(sweeps))]
        source = given[0]
        if source is None:
            raise ValueError("expected a source sweep")
        pillars = [None if cloud is None else _Pillars.of(cloud) for cloud in given]
        first = pillars[0]
        grids, encoded = [], source.points.new_zeros(0, _WIDTH)
        for number, found in enumerate(pillars):
            if found is None or not len(found.cell):
                grids.append(source.points.new_zeros(NUM_CELLS**2, _WIDTH + 1))
                continue
            features = self.encode(found.features)
            if number == 0:
                encoded = features
            grids.append(found.as_grid(features))
        flow = torch.zeros_like(source.points)
        if first is None or not len(first.row):
            return flow
        image = torch.cat(grids, dim=1).view(1, NUM_CELLS, NUM_CELLS, -1).permute(0, 3, 1, 2)
        # Where in its cell a point is tells more about it than the cell's mean.
        at_points = _at(self._unet(image), first)
        decoded = self.decode(torch.cat([at_points, encoded, first.features[:, :3]], dim=1))
        return flow.index_copy(0, first.row, decoded)

    def _unet(self, image: Tensor) -> Tensor:
        """(1,C,256,256) -> (1,32,128,128)."""
        levels = [image]
        for block in self.down:
            levels.append(block(levels[-1]))
        x = levels.pop()
        for block in self.up:
            beside = levels.pop()
            x = block(torch.cat([functional.interpolate(x, scale_factor=2.0), beside], dim=1))
        return x


def build(seed: int = 0) -> Voxels:
    """Return a network with random weights, the same for the same seed."""
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        return Voxels()


class _Block(nn.Module):
    """Two convolutions; groups are normalised, which needs no batch."""

    def __init__(self, num_in: int, num_out: int, stride: int) -> None:
        super().__init__()
        self.layers = nn.Sequential(
            nn.Conv2d(num_in, num_out, 3, stride, 1, bias=False),
            nn.GroupNorm(8, num_out),
            nn.ReLU(),
            nn.Conv2d(num_out, num_out, 3, 1, 1, bias=False),
            nn.GroupNorm(8, num_out),
            nn.ReLU(),
        )

    def forward(self, x: Tensor) -> Tensor:
        out: Tensor = self.layers(x)
        return out


class _Pillars:
    """The points of one sweep in reach, sorted by the cell they lie in.

    row: (m,) of the sweep. cell: (m,) number of the cell. features: (m,6) offset from the cell's
    middle in cells, height, and offset from the scanner in hundreds of metres. filled, size: (f,)
    number and point count of each cell that holds points; of_point: (m,) which of them.
    """

    def __init__(self, row: Tensor, cell: Tensor, features: Tensor) -> None:
        self.row, self.cell, self.features = row, cell, features
        self.filled, self.of_point, self.size = torch.unique_consecutive(
            cell, return_inverse=True, return_counts=True
        )

    @staticmethod
    def of(cloud: NetworkCloud) -> _Pillars:
        at = (cloud.points[:, :2] + REACH_M) / CELL_M
        row = torch.nonzero(((at >= 0) & (at < NUM_CELLS)).all(dim=1))[:, 0]
        cell = at[row].floor().long()
        number, order = torch.sort(cell[:, 1] * NUM_CELLS + cell[:, 0], stable=True)
        row = row[order]
        at, height_m = at[row], cloud.height_m[row].clamp(max=_LARGEST_HEIGHT_M)
        features = torch.cat(
            [at - at.floor() - 0.5, height_m[:, None] / 2 - 0.5, cloud.points[row] / 100.0], dim=1
        )
        return _Pillars(row, number, features)

    def as_grid(self, encoded: Tensor) -> Tensor:
        """Return (cells, C+1): the mean code of the points in each cell, and their number."""
        zeros = encoded.new_zeros(len(self.size), encoded.shape[1])
        sums = zeros.index_add(0, self.of_point, encoded)
        size = self.size[:, None].to(sums.dtype)
        columns = torch.cat([sums / size, torch.log1p(size) / 3], dim=1)
        grid = columns.new_zeros(NUM_CELLS**2, columns.shape[1])
        return grid.index_copy(0, self.filled, columns)


def _at(image: Tensor, pillars: _Pillars) -> Tensor:
    """Interpolate an image (1,C,128,128) at each point: (m,C)."""
    cell = torch.stack([pillars.cell % NUM_CELLS, pillars.cell // NUM_CELLS], dim=1)
    at = (cell + pillars.features[:, :2] + 0.5) * (2.0 / NUM_CELLS) - 1.0
    found = functional.grid_sample(
        image, at[None, None], padding_mode="border", align_corners=False
    )
    return found[0, :, 0].T
