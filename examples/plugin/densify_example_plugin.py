# SPDX-License-Identifier: MIT
"""Sweeps as .npy files, and an engine by which nothing moves."""

import numpy as np

from densify import FlowField, InputError, Sweep

HOLDS = "sweeps as 000000.npy, (N,4) x y z intensity, ten a second"


def recognises(path):
    return any(path.glob("[0-9]*.npy"))


def open_recording(path, scene):
    return NpySweeps(path)


class NpySweeps:
    cameras, truth = {}, None

    def __init__(self, path):
        self.files = {int(file.stem): file for file in sorted(path.glob("[0-9]*.npy"))}
        self.name, self.frames = path.name, tuple(self.files)

    def stamp_ns(self, frame):
        return frame * 100_000_000

    def __getitem__(self, frame):
        columns, stamp_ns = np.load(self.files[frame]), self.stamp_ns(frame)
        rows = np.arange(len(columns))
        points, intensity = columns[:, :3].astype(float), columns[:, 3].astype(np.float32)
        return Sweep(frame, stamp_ns, points, intensity, None, np.zeros(len(rows), np.uint8), rows)

    def T_world_lidar(self, frame):
        raise InputError(f"{self.name}: holds no poses; leave register.source at kiss-icp")


class NothingMoves:
    def __init__(self, stretch):
        self.stretch = stretch

    def flow(self, frame, target):
        return FlowField.zero(len(self.stretch[frame].sweep))


def estimate_motion(scene, settings, argument):
    return NothingMoves(scene.stretch)
