# SPDX-License-Identifier: MIT
"""The teachers against slow twins of their equations, and what they are content with."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from densify.config.errors import InputError
from densify.learning.clouds import NetworkCloud
from densify.learning.losses import TEACHERS, teacher
from densify.learning.losses.cycle import cycle_loss
from densify.learning.losses.objective import ALPHA, NUM_NEIGHBORS, objective_loss
from densify.learning.losses.pointpwc import pointpwc_energy
from densify.learning.losses.supervised import supervised_loss, weighted_error
from densify.learning.samples import Sample


def cloud(points: np.ndarray) -> NetworkCloud:
    tensor = torch.from_numpy(np.asarray(points, np.float32))
    return NetworkCloud(tensor, tensor[:, 2])


def pair(source: np.ndarray, target: np.ndarray, flow: np.ndarray | None = None) -> Sample:
    first, second = cloud(source), cloud(target)
    everything = torch.arange(len(source))
    moving = None if flow is None else torch.from_numpy(np.abs(flow).sum(1) > 0)
    return Sample(
        (first, second),
        everything,
        first,
        second,
        torch.ones(len(source), dtype=torch.bool),
        0.1,
        None if flow is None else torch.from_numpy(np.asarray(flow, np.float32)),
        moving,
    )


@pytest.fixture
def points() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Source, target of another number of points, and a flow."""
    rng = np.random.default_rng(4)
    return rng.uniform(-2, 2, (80, 3)), rng.uniform(-2, 2, (70, 3)), rng.normal(0, 0.2, (80, 3))


def squared(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    return ((a[:, None] - b[None]) ** 2).sum(-1)


def test_the_objective_is_the_published_one(points) -> None:
    source, target, flow = points
    between = squared(source, source)
    order = np.argsort(between, axis=1)[:, : NUM_NEIGHBORS + 1]
    near = np.zeros_like(between, bool)
    np.put_along_axis(near, order, True, axis=1)
    weights = np.where(near | near.T, np.exp(-between), 0.0)
    degree = weights.sum(1)
    matrix = (np.diag(degree) - weights) / np.sqrt(np.outer(degree, degree))
    apart = squared(source + flow, target)
    data = apart.min(1).sum() + apart.min(0).sum()
    expected = (data + ALPHA * np.trace(flow.T @ matrix @ flow)) / len(source)
    tensor = torch.from_numpy(flow.astype(np.float32))
    assert ALPHA == 4.0 and NUM_NEIGHBORS == 50
    got = objective_loss(lambda sweeps: tensor, pair(source, target))
    assert float(got) == pytest.approx(expected, rel=1e-5)


def test_pointpwcs_loss_is_its_equations(points) -> None:
    source, target, flow = points
    moved = source + flow
    apart = squared(moved, target)
    chamfer = apart.min(1).mean() + apart.min(0).mean()
    nearest = np.argsort(squared(source, source), axis=1)
    smoothness = np.mean(
        [((flow[r[:9]] - flow[i]) ** 2).sum(1).mean() for i, r in enumerate(nearest)]
    )
    curved = np.array([(moved[r[:10]] - moved[i]).mean(0) for i, r in enumerate(nearest)])
    around = np.argsort(squared(target, target), axis=1)[:, :10]
    of_target = np.array([(target[r] - target[i]).mean(0) for i, r in enumerate(around)])
    five = np.argsort(apart, axis=1)[:, :5]
    weight = 1 / np.take_along_axis(apart, five, axis=1)
    weight /= weight.sum(1, keepdims=True)
    expected = (weight[:, :, None] * of_target[five]).sum(1)
    curvature = ((curved - expected) ** 2).sum(1).mean()
    tensors = [torch.from_numpy(x) for x in (flow, source, target)]
    got = pointpwc_energy(*tensors)
    assert float(got) == pytest.approx(chamfer + smoothness + 0.3 * curvature, rel=1e-6)


def test_pointpwcs_gradient_is_that_of_its_value(points) -> None:
    source, target, flow = (torch.from_numpy(x) for x in points)
    flow.requires_grad_()
    pointpwc_energy(flow, source, target).backward()
    step = 1e-6
    for row, axis in ((3, 0), (40, 2), (79, 1)):
        ahead, behind = flow.detach().clone(), flow.detach().clone()
        ahead[row, axis] += step
        behind[row, axis] -= step
        values = [float(pointpwc_energy(f, source, target)) for f in (ahead, behind)]
        assert float(flow.grad[row, axis]) == pytest.approx(
            (values[0] - values[1]) / (2 * step), rel=1e-5
        )


def test_the_cycle_is_content_with_the_true_motion_only() -> None:
    rng = np.random.default_rng(1)
    source, step = rng.uniform(-5, 5, (60, 3)), np.array([0.4, 0.1, 0.0])
    sample = pair(source, source + step)
    forth = torch.from_numpy(np.float32(step))

    def network(sign: float):
        asked = iter((1.0, -1.0))
        return lambda sweeps: sign * next(asked) * forth.expand(len(sweeps[0].points), 3)

    assert float(cycle_loss(network(1.0), sample)) == pytest.approx(0, abs=1e-9)
    apart = squared(source, source + step)
    nearest = (source + step)[apart.argmin(1)]
    anchor = (nearest - source) / 2
    expected = apart.min(1).mean() + (anchor**2).sum(1).mean()
    assert float(cycle_loss(network(0.0), sample)) == pytest.approx(expected, rel=1e-4)


def test_moving_and_standing_points_weigh_the_same() -> None:
    true = np.zeros((100, 3))
    true[98], true[99] = [0.05, 0, 0], [2.0, 0, 0]  # 0.5 and 20 m/s
    sample = pair(np.zeros((100, 3)), np.zeros((5, 3)), true)
    off = torch.zeros(100, 3)
    off[:98, 1], off[98], off[99] = 0.01, torch.tensor([0.05, 0.2, 0]), torch.tensor([2, 0, 0.5])
    assert float(supervised_loss(lambda sweeps: off, sample)) == pytest.approx(0.71, abs=1e-3)


def test_what_does_not_count_does_not_count() -> None:
    nothing = torch.zeros(4, dtype=torch.bool)
    flow = torch.ones(4, 3, requires_grad=True)
    loss = weighted_error(flow, torch.zeros(4, 3), nothing, nothing, nothing)
    loss.backward()
    assert float(loss.detach()) == 0 and not flow.grad.any()


@pytest.mark.parametrize("name", TEACHERS)
def test_every_teacher_has_finite_gradients_where_all_is_right(name: str) -> None:
    rng = np.random.default_rng(0)
    source = rng.uniform(-3, 3, (70, 3))
    flow = torch.zeros(70, 3, requires_grad=True)
    loss = teacher(name).loss(lambda sweeps: flow, pair(source, source.copy(), np.zeros((70, 3))))
    loss.backward()
    assert float(loss.detach()) < 0.01 and torch.isfinite(flow.grad).all()


def test_an_unknown_teacher_is_named() -> None:
    with pytest.raises(InputError, match=r"--teacher mother: expected one of objective, pointpwc"):
        teacher("mother")
