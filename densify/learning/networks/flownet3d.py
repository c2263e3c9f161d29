# SPDX-License-Identifier: MIT
"""FlowNet3D (Liu, Qi, Guibas, CVPR 2019) in plain torch: set convolutions, flow embedding, and set
up-convolutions, layer by layer as in their table 1, for 2,048 to 8,192 points.

Differences: the k nearest neighbours are taken where they take up to k within a radius (their
radius is an upper limit here too), groups are normalised instead of batches, and a point's height
above the ground is its feature where they have colours.
"""

from __future__ import annotations

import torch
from torch import Tensor, nn

from densify.learning.clouds import NetworkCloud, Sweeps

NUM_POINTS = 8192
"""A larger sweep is thinned to so many points; the others take the flow of the nearest three."""
_NUM_CARRIED = 3
_CHUNK = 2048


class FlowNet3D(nn.Module):
    """1.2 million weights."""

    num_sweeps = 2

    def __init__(self) -> None:
        super().__init__()
        self.set1 = _SetConv(1, (32, 32, 64), 1024, 0.5, 16)
        self.set2 = _SetConv(64, (64, 64, 128), 256, 1.0, 16)
        self.embed = _FlowEmbedding(128, (128, 128, 128), 64)
        self.set3 = _SetConv(128, (128, 128, 256), 64, 2.0, 8)
        self.set4 = _SetConv(256, (256, 256, 512), 16, 4.0, 8)
        self.up1 = _SetUpConv(512, 256, (), (256, 256), 8)
        self.up2 = _SetUpConv(256, 256, (128, 128, 256), (256,), 8)
        self.up3 = _SetUpConv(256, 64, (128, 128, 256), (256,), 8)
        self.propagate = _Layers(256 + 1, (256, 256))
        self.head = nn.Sequential(_Layers(256, (128,)), nn.Linear(128, 3))
        with torch.no_grad():  # to begin with little moves, as in the world
            self.head[-1].weight.mul_(0.1)  # type: ignore[operator, union-attr]
            self.head[-1].bias.zero_()  # type: ignore[operator, union-attr]

    def forward(self, sweeps: Sweeps) -> Tensor:
        """Flow (n,3) of the first sweep to the second."""
        source, target = sweeps[0], sweeps[1]
        if source is None or target is None:
            raise ValueError("expected a source and a target sweep")
        if not (len(source.points) and len(target.points)):
            return torch.zeros_like(source.points)
        few, few_target = _thinned(source), _thinned(target)
        flow = self._flow(few, few_target)
        if len(few.points) == len(source.points):
            return flow
        return _carried(flow, few.points, source.points)

    def _flow(self, source: NetworkCloud, target: NetworkCloud) -> Tensor:
        p0, f0 = source.points, source.height_m[:, None]
        p1, f1 = self.set1(p0, f0)
        p2, f2 = self.set2(p1, f1)
        q1, g1 = self.set1(target.points, target.height_m[:, None])
        q2, g2 = self.set2(q1, g1)
        e2 = self.embed(p2, f2, q2, g2)
        p3, f3 = self.set3(p2, e2)
        p4, f4 = self.set4(p3, f3)
        u3 = self.up1(p4, f4, p3, f3)
        u2 = self.up2(p3, u3, p2, torch.cat([f2, e2], dim=1))
        u1 = self.up3(p2, u2, p1, f1)
        u0 = self.propagate(torch.cat([_interpolated(p1, u1, p0), f0], dim=1))
        flow: Tensor = self.head(u0)
        return flow


class _Layers(nn.Module):
    """Fully connected, over the last dimension, each normalised and rectified."""

    def __init__(self, num_in: int, widths: tuple[int, ...]) -> None:
        super().__init__()
        layers: list[nn.Module] = []
        for width in widths:
            layers += [nn.Linear(num_in, width), nn.LayerNorm(width), nn.ReLU()]
            num_in = width
        self.layers = nn.Sequential(*layers)

    def forward(self, x: Tensor) -> Tensor:
        out: Tensor = self.layers(x)
        return out


class _SetConv(nn.Module):
    """Section 4.1: points far apart are chosen, and each takes the largest features around it."""

    def __init__(
        self, num_in: int, widths: tuple[int, ...], num_points: int, radius_m: float, k: int
    ) -> None:
        super().__init__()
        self.layers = _Layers(num_in + 3, widths)
        self.num_points, self.radius_m, self.k = num_points, radius_m, k

    def forward(self, points: Tensor, features: Tensor) -> tuple[Tensor, Tensor]:
        chosen = points[farthest_points(points, self.num_points)]
        near, within = _neighbors(chosen, points, self.k, self.radius_m)
        offset = points[near] - chosen[:, None]
        around = self.layers(torch.cat([offset, features[near]], dim=2))
        around = around.masked_fill(~within[:, :, None], -torch.inf)
        return chosen, around.amax(dim=1)


class _FlowEmbedding(nn.Module):
    """Section 4.2: each source point with the k target points nearest to it."""

    def __init__(self, num_in: int, widths: tuple[int, ...], k: int) -> None:
        super().__init__()
        self.layers = _Layers(2 * num_in + 3, widths)
        self.k = k

    def forward(self, p: Tensor, f: Tensor, q: Tensor, g: Tensor) -> Tensor:
        near, _ = _neighbors(p, q, self.k)
        own = f[:, None].expand(-1, near.shape[1], -1)
        mixed = torch.cat([q[near] - p[:, None], own, g[near]], dim=2)
        out: Tensor = self.layers(mixed).amax(dim=1)
        return out


class _SetUpConv(nn.Module):
    """Section 4.3: features of few points are brought to many."""

    def __init__(
        self,
        num_in: int,
        num_beside: int,
        widths: tuple[int, ...],
        after: tuple[int, ...],
        k: int,
    ) -> None:
        super().__init__()
        self.layers = _Layers(num_in + 3, widths) if widths else None
        self.after = _Layers((widths[-1] if widths else num_in + 3) + num_beside, after)
        self.k = k

    def forward(self, few: Tensor, features: Tensor, many: Tensor, beside: Tensor) -> Tensor:
        near, _ = _neighbors(many, few, self.k)
        around = torch.cat([few[near] - many[:, None], features[near]], dim=2)
        if self.layers is not None:
            around = self.layers(around)
        out: Tensor = self.after(torch.cat([around.amax(dim=1), beside], dim=1))
        return out


@torch.no_grad()
def farthest_points(points: Tensor, count: int) -> Tensor:
    """(count,) rows, or all where there are fewer: the first, then always the one that is farthest
    from all chosen (Eldar et al., 1997)."""
    if len(points) <= count:
        return torch.arange(len(points), device=points.device)
    chosen = torch.zeros(count, dtype=torch.long, device=points.device)
    nearest = torch.full((len(points),), torch.inf, device=points.device)
    for n in range(1, count):
        offset = points - points[chosen[n - 1]]
        nearest = torch.minimum(nearest, (offset * offset).sum(dim=1))
        chosen[n] = nearest.argmax()
    return chosen


@torch.no_grad()
def _neighbors(
    queries: Tensor, points: Tensor, k: int, radius_m: float | None = None
) -> tuple[Tensor, Tensor]:
    """(q,k) rows of the nearest points, fewer where there are fewer, and which lie within the
    radius; the nearest always counts."""
    k = min(k, len(points))
    rows, far = [], []
    for some in torch.split(queries, _CHUNK):
        found = torch.cdist(some, points).topk(k, dim=1, largest=False)
        rows.append(found.indices)
        far.append(found.values)
    within = torch.cat(far) <= (torch.inf if radius_m is None else radius_m)
    within[:, 0] = True
    return torch.cat(rows), within


def _interpolated(few: Tensor, features: Tensor, many: Tensor) -> Tensor:
    """The three nearest, weighed by inverse distance."""
    near, _ = _neighbors(many, few, _NUM_CARRIED)
    weight = 1 / ((few[near] - many[:, None]).norm(dim=2) + 1e-6)
    weight = weight / weight.sum(dim=1, keepdim=True)
    return (weight[:, :, None] * features[near]).sum(dim=1)


def _carried(flow: Tensor, few: Tensor, many: Tensor) -> Tensor:
    return torch.cat([_interpolated(few, flow, some) for some in torch.split(many, _CHUNK)])


def _thinned(cloud: NetworkCloud) -> NetworkCloud:
    """Every so many points, in the order of the sweep."""
    count = len(cloud.points)
    if count <= NUM_POINTS:
        return cloud
    index = torch.arange(NUM_POINTS, device=cloud.points.device) * count // NUM_POINTS
    return cloud.rows(index)
