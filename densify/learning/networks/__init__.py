# SPDX-License-Identifier: MIT
"""The networks by name: each takes sweeps (`densify.learning.clouds.Sweeps`) to the flow (n,3),
metres, of the first to the second."""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import nn

from densify.config.errors import InputError
from densify.learning.networks.flownet3d import FlowNet3D
from densify.learning.networks.voxels import Voxels

NETWORKS: dict[str, Callable[[], nn.Module]] = {"voxels": Voxels, "flownet3d": FlowNet3D}


def build(name: str, seed: int = 0) -> nn.Module:
    """A network with random weights, the same for the same seed; whatever else is random stays as
    it was. Raises InputError for another name."""
    if name not in NETWORKS:
        raise InputError(f"--model {name}: expected one of {', '.join(NETWORKS)}")
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        return NETWORKS[name]()
