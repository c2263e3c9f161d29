# SPDX-License-Identifier: MIT
"""The networks: what their answers may depend on."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from densify.config.errors import InputError
from densify.learning.clouds import NetworkCloud, order_for
from densify.learning.networks import NETWORKS, build
from densify.learning.networks.flownet3d import NUM_POINTS, farthest_points
from densify.learning.networks.voxels import REACH_M, _SegmentSum
from densify.learning.threads import on_one_thread


def cloud(count: int, seed: int = 0, reach_m: float = 30.0) -> NetworkCloud:
    rng = np.random.default_rng(seed)
    points = rng.uniform(-reach_m, reach_m, (count, 3)).astype(np.float32)
    points[:, 2] = rng.uniform(-1.5, 1.0, count)
    return NetworkCloud(torch.from_numpy(points), torch.from_numpy(points[:, 2] + 1.7))


@pytest.fixture(params=NETWORKS)
def network(request) -> torch.nn.Module:
    return build(request.param).eval()


def test_flow_has_a_row_for_every_point(network) -> None:
    with torch.inference_mode():
        for given in ([cloud(500), cloud(300, 1)], [cloud(500), cloud(40, 1), None]):
            flow = network(given)
            assert flow.shape == (500, 3) and torch.isfinite(flow).all() and flow.any()
        assert network([cloud(0), cloud(9)]).shape == (0, 3)


def test_the_target_matters(network) -> None:
    with torch.inference_mode():
        one, other = network([cloud(500), cloud(300, 1)]), network([cloud(500), cloud(300, 2)])
    assert (one != other).any()


def test_weights_follow_from_the_seed_alone(network) -> None:
    name = next(n for n in NETWORKS if isinstance(network, type(build(n))))
    state = torch.random.get_rng_state()
    again, other = build(name), build(name, seed=1)
    assert torch.equal(torch.random.get_rng_state(), state)
    pairs = list(zip(network.parameters(), again.parameters(), other.parameters(), strict=True))
    assert all(torch.equal(a, b) for a, b, _ in pairs)
    assert any(not torch.equal(a, c) for a, _, c in pairs)


def test_weights_are_below_8_mb(network) -> None:
    assert sum(p.numel() * p.element_size() for p in network.parameters()) < 8e6


def test_the_order_of_points_means_nothing_to_voxels() -> None:
    network, source, target = build("voxels").eval(), cloud(2000), cloud(1500, 1)
    order = torch.randperm(2000, generator=torch.Generator().manual_seed(3))
    with torch.inference_mode():
        flow = network([source, target])
        shuffled = network([source.rows(order), target])
    torch.testing.assert_close(shuffled, flow[order], atol=1e-5, rtol=1e-4)


def test_voxels_say_nothing_beyond_their_reach() -> None:
    source = cloud(2000, reach_m=2 * REACH_M)
    beyond = (source.points[:, :2].abs() > REACH_M).any(dim=1)
    with torch.inference_mode():
        flow = build("voxels")([source, cloud(100, 1)])
    assert not flow[beyond].any() and flow[~beyond].any(dim=1).all()


def test_a_whole_sweep_gives_the_same_bytes_on_one_thread() -> None:
    network, given = build("voxels").eval(), [cloud(120_000, n) for n in range(3)]
    found = []
    for threads in (1, 2):
        torch.set_num_threads(threads)
        with on_one_thread(), torch.inference_mode():
            found.append(network(given))
        assert torch.get_num_threads() == threads
    assert torch.equal(*found)


def test_sums_of_segments_and_their_gradient() -> None:
    values = torch.arange(12.0).reshape(6, 2).requires_grad_()
    sizes, of_row = torch.tensor([1, 3, 2]), torch.tensor([0, 1, 1, 1, 2, 2])
    sums = _SegmentSum.apply(values, sizes, of_row)
    assert sums.tolist() == [[0, 1], [12, 15], [18, 20]]
    (sums * torch.tensor([[1.0], [2.0], [3.0]])).sum().backward()
    assert values.grad[:, 0].tolist() == [1, 2, 2, 2, 3, 3]


def test_points_far_apart_are_chosen() -> None:
    points = cloud(40).points
    chosen = farthest_points(points, 7).tolist()
    assert chosen[0] == 0
    for n in range(1, 7):
        apart = [min(float((p - points[c]).norm()) for c in chosen[:n]) for p in points]
        assert apart[chosen[n]] == pytest.approx(max(apart))
    assert farthest_points(points, 99).tolist() == list(range(40))


def test_flownet3d_carries_flow_to_points_it_did_not_see() -> None:
    source = cloud(NUM_POINTS + 500)
    network = build("flownet3d").eval()
    with torch.inference_mode():
        flow = network([source, cloud(600, 1)])
        few = torch.arange(NUM_POINTS) * len(flow) // NUM_POINTS
        seen = network([source.rows(few), cloud(600, 1)])
    torch.testing.assert_close(flow[few], seen, atol=1e-4, rtol=1e-3)
    unseen = np.setdiff1d(np.arange(len(flow)), few.numpy())
    assert (flow[unseen] <= seen.amax(0) + 1e-5).all()


def test_sweeps_before_the_source_come_in_the_direction_of_time() -> None:
    assert order_for(3, 4, 7, 4) == [3, 4, 2, 1]
    assert order_for(3, 2, 5, 4) == [3, 2, 4, None]
    assert order_for(0, 1, 5, 3) == [0, 1, None]


def test_an_unknown_network_is_named() -> None:
    with pytest.raises(InputError, match="--model resnet: expected one of voxels, flownet3d"):
        build("resnet")
