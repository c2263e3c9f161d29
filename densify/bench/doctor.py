# SPDX-License-Identifier: MIT
"""Measure how often ``densify doctor`` detects errors of calibrations, poses and clocks."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from densify.bench.depth import Altered
from densify.config import Config
from densify.config.errors import InputError
from densify.doctor import Sample, Verdict
from densify.doctor.cameras import camera_views, check_calibration
from densify.doctor.motion import check_poses
from densify.doctor.sample import Finding
from densify.geometry.types import Camera, Float, LidarSequence, Progress
from densify.readers.recorded_poses import PoseTrack
from densify.scores.edge_fit import Silhouettes, View, turned

# Sizes of the errors: rotation and translation of cameras; clocks; scale and climb of poses
_TURNS_DEG, _SHIFTS_M = (0.5, 1.0, 2.0), (0.02, 0.05, 0.1)
_CLOCKS_S, _SCALES, _CLIMBS_M_S = (0.01, 0.03, 0.1), (0.01, 0.03, 0.1), (0.2,)
_AXES = ("pitch", "yaw", "roll")


def bench_doctor(
    sequences: Sequence[LidarSequence], config: Config, progress: Progress | None = None
) -> dict[str, dict[str, Any]]:
    """Inject known errors into recordings, and count the verdicts of the doctor's checks.

    Args:
        sequences: The recordings, taken as free of errors.
        config: Settings, of which those of registration are used.

    Returns:
        Name of the error -> number of cases (``of``), and the share (0 to 1) of each verdict.
    """
    counts: dict[str, Counter[Verdict]] = {}
    for number, sequence in enumerate(sequences):
        if progress:
            progress("recordings", number, len(sequences))
        sample = Sample.of(sequence, config.register)
        for mistake, findings in (*_check_cameras(sample), *_check_poses(sample)):
            of_clock = "clock" in mistake
            # An error of a clock is judged by the checks of clocks, others by the other checks.
            verdicts = [
                finding.verdict for finding in findings if ("clock" in finding.check) == of_clock
            ]
            counts.setdefault(mistake, Counter())[max(verdicts, default=Verdict.UNKNOWN)] += 1
    return {
        mistake: {"of": count.total()}
        | {str(verdict): count[verdict] / count.total() for verdict in Verdict}
        for mistake, count in counts.items()
    }


def _check_cameras(sample: Sample) -> Iterator[tuple[str, list[Finding]]]:
    """Yield the name of an error and the findings about a camera that has this error."""
    silhouettes: dict[int, Silhouettes] = {}
    for camera in sample.sequence.cameras.values():
        views = camera_views(sample, camera, silhouettes)[0]
        if views:
            for mistake, wrong_camera, wrong_views in _with_mistakes(camera, views):
                yield mistake, check_calibration(wrong_camera, wrong_views)


def _with_mistakes(camera: Camera, views: list[View]) -> Iterator[tuple[str, Camera, list[View]]]:
    """Yield the name of an error, and the camera and views that have this error."""
    yield "cameras as they are", camera, views
    yield "camera's clock as it is", camera, views
    for size in _TURNS_DEG:
        for row, axis in enumerate(_AXES):
            for turn in (size, -size):
                yield f"{axis} {size:g} deg", turned(camera, turn * np.eye(4)[row]), views
    for size in _SHIFTS_M:
        for shift in (*size * np.eye(3), *-size * np.eye(3)):
            T_cam_lidar = camera.T_cam_lidar.copy()
            T_cam_lidar[:3, 3] += shift
            yield f"shift {100 * size:g} cm", replace(camera, T_cam_lidar=T_cam_lidar), views
    for size in _CLOCKS_S:
        for late_s in (size, -size):
            late = [view._replace(exposed_s=view.exposed_s + late_s) for view in views]
            yield f"camera's clock {1000 * size:g} ms", camera, late


def _check_poses(sample: Sample) -> Iterator[tuple[str, list[Finding]]]:
    """Yield the name of an error and the findings about poses that have this error."""
    sequence = sample.sequence
    stamp_ns, row = sample.timeline.stamp_ns, sample.timeline.row
    try:
        T_world_lidar = np.stack([sequence.T_world_lidar(f) for f in sample.timeline.frames])
    except InputError:  # the recording has no poses
        return
    track = PoseTrack(sequence.name, stamp_ns, T_world_lidar)

    def check_altered_poses(
        scale: float = 1.0,  # factor of all distances from the first pose
        climb_m_s: float = 0.0,  # vertical velocity that is added
        late_s: float = 0.0,  # delay of the poses' clock
    ) -> list[Finding]:
        def altered_pose(frame: int) -> Float:
            frame_ns = int(stamp_ns[row[frame]])
            moment_ns = frame_ns - round(1e9 * late_s)
            T = track.at(int(np.clip(moment_ns, stamp_ns[0], stamp_ns[-1]))).copy()
            start_m = T_world_lidar[0, :3, 3]
            T[:3, 3] = scale * (T[:3, 3] - start_m) + start_m
            T[2, 3] += climb_m_s * (frame_ns - int(stamp_ns[0])) * 1e-9
            return T

        altered: Any = Altered(sequence, T_world_lidar=altered_pose)
        return check_poses(replace(sample, sequence=altered))

    yield "poses as they are", check_altered_poses()
    yield "clock of poses as it is", check_altered_poses()
    for sign in (1, -1):
        for size in _SCALES:
            yield (
                f"poses {100 * size:g} % too long or short",
                check_altered_poses(scale=1 + sign * size),
            )
        for size in _CLIMBS_M_S:
            yield f"poses climb {size:g} m/s", check_altered_poses(climb_m_s=sign * size)
        for size in _CLOCKS_S:
            yield f"clock of poses {1000 * size:g} ms", check_altered_poses(late_s=sign * size)
