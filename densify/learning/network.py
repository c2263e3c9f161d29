# SPDX-License-Identifier: MIT
"""Define a network for whole sweeps, and use it as an engine of scene flow.

Points go to a grid of pillars, through a U-Net, and back to points. It follows FastFlow3D (Jund et
al., "Scalable Scene Flow from Point Clouds in the Real World", RA-L 2022) and DeFlow (Zhang et al.,
ICRA 2024), and is small enough for a CPU. Cells are 0.4 m. As an engine, its flow proposes and
`densify.flow.tracking` decides.

A model file is a numpy archive, read without running any code. ``header`` holds JSON (format,
version, network, how it was trained), ``weights/NAME`` the network's arrays.
"""

from __future__ import annotations

import io
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import pairwise
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn
from torch.nn import functional

from densify.config import Config
from densify.config.errors import InputError
from densify.config.file_content import parse_json
from densify.flow.energy import on_one_thread
from densify.flow.engines import Scene
from densify.flow.tracking.candidates import Obstacles, cluster_rings
from densify.flow.tracking.groups import GroupMotion, find_group_motion
from densify.free_space.ground import ABOVE_GROUND_M, HeightMap
from densify.geometry import poses
from densify.geometry.types import Float, Float32, Int, RegisteredSweep
from densify.outputs.folders import write_file
from densify.readers.decoded_files import read_arrays

CELL_M = 0.4  # side of a cell of the grid
NUM_CELLS = 256  # cells along x, and along y
REACH_M = CELL_M * NUM_CELLS / 2  # points farther from the scanner along x or y have no flow
NUM_SWEEPS = 3  # source, target, and a sweep before the source
_NUM_POINT_FEATURES = 6  # of `_Pillars.features`
_WIDTH = 16  # numbers of a point's code
_WIDTHS = (32, 48, 64, 96)  # channels of the levels of the U-Net
_LARGEST_HEIGHT_M = 4.0  # greater heights count as this one


# The network's input, in training and inference: points above the ground, ego-motion removed


class NetworkCloud(NamedTuple):
    """One sweep of n points as input of the network."""

    # (n,3) float32 metres, world axes (z up), origin at the *source* sweep's scanner
    points: Tensor
    height_m: Tensor  # (n,) float32 height above the ground


class AboveGround(NamedTuple):
    """The n points of a sweep above the ground."""

    row: Int  # (n,) index into the sweep's points
    points: Float  # (n,3) metres, world
    height_m: Float32  # (n,) height above the ground

    @staticmethod
    def of(registered: RegisteredSweep, ground: HeightMap, row: Int | None = None) -> AboveGround:
        """Return a sweep's points above the ground, or its points at given rows (n,)."""
        points = poses.transform(registered.T_world_lidar, registered.sweep.points)
        height_m = ground.above(points)
        row = np.flatnonzero(height_m >= ABOVE_GROUND_M) if row is None else row
        return AboveGround(row, points[row], height_m[row])

    def cloud(self, origin: Float) -> NetworkCloud:
        """Return the points as network input, relative to an origin (3,), world."""
        points = torch.from_numpy((self.points - origin).astype(np.float32))
        return NetworkCloud(points, torch.from_numpy(np.ascontiguousarray(self.height_m)))


def order_for(source: int, target: int, num_sweeps: int) -> list[int | None]:
    """Return the indices of the sweeps that the network needs for the flow from source to target.

    They are source, target, and the sweep on the other side of the source. An index that does not
    exist among ``num_sweeps`` is None.
    """
    before_source = source - (target - source)
    indices = source, target, before_source
    return [index if 0 <= index < num_sweeps else None for index in indices]


Sweeps = Sequence[NetworkCloud | None]
"""Source, target, and a sweep before the source; None for a missing sweep."""


class Voxels(nn.Module):
    """The scene flow network, with 0.5 million weights."""

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
        with torch.no_grad():  # start with small flow, because most points are static
            self.decode[-1].weight.mul_(0.1)  # type: ignore[operator, union-attr]
            self.decode[-1].bias.zero_()  # type: ignore[operator, union-attr]

    def forward(self, sweeps: Sweeps) -> Tensor:
        """Return the flow (n,3), metres, world axes, of the source's points; 0 outside the grid."""
        source = sweeps[0]
        if source is None:
            raise ValueError("expected a source sweep")
        flow, pillars = torch.zeros_like(source.points), _Pillars.of(source)
        if not len(pillars.row):
            return flow
        codes = self.encode(pillars.features)
        # All sweeps are side by side in the channels of one image. A missing sweep is 0.
        grids = [pillars.as_grid(codes)]
        missing_sweeps = [None] * (NUM_SWEEPS - len(sweeps))
        for cloud in (*sweeps[1:], *missing_sweeps):
            other_pillars = None if cloud is None else _Pillars.of(cloud)
            if other_pillars is None or not len(other_pillars.row):
                grids.append(flow.new_zeros(NUM_CELLS**2, _WIDTH + 1))
            else:
                grids.append(other_pillars.as_grid(self.encode(other_pillars.features)))
        image = torch.cat(grids, dim=1).view(1, NUM_CELLS, NUM_CELLS, -1).permute(0, 3, 1, 2)
        # A point's flow depends on the cells around it, its own code and its position in its cell.
        at_points = _interpolate_at(self._unet(image), pillars)
        decoded = self.decode(torch.cat([at_points, codes, pillars.features[:, :3]], dim=1))
        return flow.index_copy(0, pillars.row, decoded)

    def _unet(self, image: Tensor) -> Tensor:
        """Return the codes (1,32,128,128) of an image (1,C,256,256), by the U-Net."""
        levels = [image]
        for block in self.down:
            levels.append(block(levels[-1]))
        x = levels.pop()
        for block in self.up:
            skipped = levels.pop()  # level of the same size on the way down
            x = block(torch.cat([functional.interpolate(x, scale_factor=2.0), skipped], dim=1))
        return x


def build(seed: int = 0) -> Voxels:
    """Return a network with random weights, the same for the same seed."""
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        return Voxels()


class _Block(nn.Module):
    """Two convolutions with group normalisation, which works without batches."""

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
        """Return the features (1,num_out,h,w) of an image (1,num_in,H,W), smaller by the stride."""
        out: Tensor = self.layers(x)
        return out


class _Pillars(NamedTuple):
    """The m points of one sweep within the grid, sorted by cell."""

    row: Tensor  # (m,) index into the sweep's points
    cell: Tensor  # (m,) number of the cell, row by row: x + 256 y
    # (m,6) offset from the cell's centre in cells, scaled height, and offset from the scanner in
    # hundreds of metres
    features: Tensor

    @staticmethod
    def of(cloud: NetworkCloud) -> _Pillars:
        """Return the points of a cloud within the grid, with their features."""
        xy = (cloud.points[:, :2] + REACH_M) / CELL_M  # in cells
        row = torch.nonzero(((xy >= 0) & (xy < NUM_CELLS)).all(dim=1))[:, 0]
        cell_xy = xy[row].floor().long()
        cell, order = torch.sort(cell_xy[:, 1] * NUM_CELLS + cell_xy[:, 0], stable=True)
        row = row[order]
        xy, height_m = xy[row], cloud.height_m[row].clamp(max=_LARGEST_HEIGHT_M)
        features = xy - xy.floor() - 0.5, height_m[:, None] / 2 - 0.5, cloud.points[row] / 100.0
        return _Pillars(row, cell, torch.cat(features, dim=1))

    def as_grid(self, encoded: Tensor) -> Tensor:
        """Return each cell's mean code and scaled log of its point count, (cells, C + 1)."""
        # The cells with points, the index of each point's cell among these cells, and point counts
        filled_cells, index_of_point, counts = torch.unique_consecutive(
            self.cell, return_inverse=True, return_counts=True
        )
        zeros = encoded.new_zeros(len(counts), encoded.shape[1])
        sums = zeros.index_add(0, index_of_point, encoded)
        num_points = counts[:, None].to(sums.dtype)
        columns = torch.cat([sums / num_points, torch.log1p(num_points) / 3], dim=1)
        grid = columns.new_zeros(NUM_CELLS**2, columns.shape[1])
        return grid.index_copy(0, filled_cells, columns)


def _interpolate_at(image: Tensor, pillars: _Pillars) -> Tensor:
    """Return the values (m,C) of an image (1,C,128,128), interpolated at each of m points."""
    cell_xy = torch.stack([pillars.cell % NUM_CELLS, pillars.cell // NUM_CELLS], dim=1)
    grid_xy = (cell_xy + pillars.features[:, :2] + 0.5) * (2.0 / NUM_CELLS) - 1.0  # -1 to 1
    sampled = functional.grid_sample(
        image, grid_xy[None, None], padding_mode="border", align_corners=False
    )
    return sampled[0, :, 0].T


_IDENTITY = {"format": "densify model", "version": 1, "network": "voxels"}
_HEADER, _WEIGHTS = "header", "weights/"


@dataclass(frozen=True)
class Model:
    """A network with its weights."""

    network: Voxels
    provenance: Mapping[str, Any] = field(default_factory=dict)  # how it was trained, for JSON

    def flow(self, sweeps: Sweeps) -> Float:
        """Return the flow (n,3), metres, of the source's points, equal on any number of cores."""
        with on_one_thread(), torch.inference_mode():
            displacement_m: Float = self.network(sweeps).double().numpy()
        return displacement_m


def write_model(path: Path, model: Model) -> None:
    """Write a model to a file; the same model gives the same bytes."""
    text = json.dumps({**_IDENTITY, "made": model.provenance}, sort_keys=True).encode()
    arrays: dict[str, NDArray[Any]] = {_HEADER: np.frombuffer(text, np.uint8)}
    for name, tensor in model.network.state_dict().items():
        arrays[_WEIGHTS + name] = tensor.detach().cpu().numpy()
    buffer = io.BytesIO()
    np.savez(buffer, **arrays)  # type: ignore[arg-type]
    write_file(path, buffer.getvalue())


def read_model(path: Path) -> Model:
    """Return the model in a file, or raise InputError if the file is no model of this version."""
    if not path.is_file():
        raise InputError(f"{path}: no such file; expected a model that densify train flow wrote")
    arrays = read_arrays(path)
    try:
        header = dict(parse_json(bytes(arrays.pop(_HEADER).astype(np.uint8)), path))
        identity = tuple(header[name] for name in _IDENTITY)
        provenance = dict(header["made"])
    except (KeyError, ValueError, TypeError, InputError):
        raise InputError(f"{path}: no model that densify train flow wrote") from None
    expected = tuple(_IDENTITY.values())
    if identity != expected:
        raise InputError(f"{path}: got {identity}, expected {expected}; train it again")
    network = build()
    weights = {name.removeprefix(_WEIGHTS): array for name, array in arrays.items()}
    if not all(np.isfinite(array).all() for array in weights.values()):
        raise InputError(f"{path}: weights that are not finite; train it again")
    try:
        network.load_state_dict({name: torch.from_numpy(array) for name, array in weights.items()})
    except (RuntimeError, TypeError) as error:
        raise InputError(f"{path}: damaged: {error}; train it again") from error
    return Model(network.train(False), provenance)


# Least speed by the network of points that may start a track (Chodosh et al., WACV 2024)
MOVES_M_S = 0.5


def check_argument(argument: str) -> None:
    """Raise InputError unless the argument is the path of a readable model file."""
    read_model(Path(argument))


def estimate_motion(scene: Scene, settings: Config, argument: str) -> GroupMotion:
    """Return the motion of objects that start from the flow of the model file ``argument``."""
    model = read_model(Path(argument))
    sweeps = scene.stretch.sweeps
    pairs = zip(sweeps, scene.obstacles, strict=True)
    above = [AboveGround.of(sweep, scene.ground, obstacles.row) for sweep, obstacles in pairs]
    flows = flows_of(model, above, [registered.T_world_lidar[:3, 3] for registered in sweeps])
    stamps_s = [registered.sweep.stamp_ns * 1e-9 for registered in sweeps]
    clustered, velocities_m_s = [], []
    for index, flow in enumerate(flows):
        duration_s = 1.0  # for a single sweep, whose flow is 0
        if len(above) > 1:
            duration_s = stamps_s[_neighbor(index, len(above))] - stamps_s[index]
        point_m_s = flow / duration_s
        point_m_s[:, 2] = 0.0
        obstacles, cluster_m_s = _cluster(scene, index, above[index].points, point_m_s)
        clustered.append(obstacles)
        velocities_m_s.append(cluster_m_s)
    return find_group_motion(scene, clustered, velocities_m_s)


def flows_of(model: Model, above: list[AboveGround], origins: list[Float]) -> list[Float]:
    """Return, for each sweep, the flow (n,3) to the next sweep, metres, world, ego-motion removed.

    The last sweep has its flow to the previous sweep. A single sweep has flow 0. ``above`` holds
    the points of each sweep, ``origins`` the position (3,) of its scanner, world.
    """
    flows = []
    for index, source in enumerate(above):
        if len(above) < 2 or not len(source.row):
            flows.append(np.zeros((len(source.row), 3)))
            continue
        needed = order_for(index, _neighbor(index, len(above)), len(above))
        clouds = [None if i is None else above[i].cloud(origins[index]) for i in needed]
        flows.append(model.flow(clouds))
    return flows


def _neighbor(index: int, num_sweeps: int) -> int:
    """Return the index of the sweep after a sweep, or of the sweep before the last sweep."""
    return index + 1 if index + 1 < num_sweeps else index - 1


def _cluster(
    scene: Scene, index: int, points: Float, velocity_m_s: Float
) -> tuple[Obstacles, Float]:
    """Return a sweep's n obstacles with new clusters, and the velocities (n,3) of these clusters.

    ``points`` (n,3, world) are the obstacles, ``velocity_m_s`` (n,3) the network's velocities.
    """
    # Clusters that move according to the network may start a track, at their median velocity.
    # Clusters from free-space violations alone may only join a track that was started elsewhere.
    moves = np.linalg.norm(velocity_m_s, axis=1) >= MOVES_M_S
    obstacles, registered = scene.obstacles[index], scene.stretch.sweeps[index]
    sensors = scene.space.sensors
    num_moving, cluster = cluster_rings(points, obstacles.row, moves, registered, sensors)
    cluster_m_s = np.zeros_like(velocity_m_s)
    for k in range(num_moving):
        members = cluster == k
        cluster_m_s[members] = np.median(velocity_m_s[members & moves], axis=0)
    is_only_seen_through = (cluster < 0) & obstacles.candidate
    label = np.where(is_only_seen_through, num_moving + obstacles.cluster, cluster)
    seed = obstacles.seed & (cluster >= 0)
    num_clusters = num_moving + obstacles.num_clusters
    return replace(obstacles, seed=seed, cluster=label, num_clusters=num_clusters), cluster_m_s
