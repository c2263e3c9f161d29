# SPDX-License-Identifier: MIT
"""Describe a recording in a few aligned lines."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from densify.config.errors import InputError
from densify.geometry.types import Int, LidarSequence, Sweep
from densify.readers.timeline import Timeline, format_frames

_MOST_NAMED = 3  # most unusable sweeps that are listed with a reason


def describe(sequence: LidarSequence) -> str:
    """Return a summary of a recording as aligned lines of text, as `findings` lists it."""
    return in_lines(findings(sequence))


def in_lines(lines: Sequence[tuple[str, str]]) -> str:
    """Return (name, text) pairs as lines in which all texts start in the same column."""
    width = max(len(label) for label, _ in lines) + 2
    return "\n".join(f"{label:<{width}}{text}" for label, text in lines)


def findings(sequence: LidarSequence) -> list[tuple[str, str]]:
    """Summarise a recording as (name, text) pairs; load only its first and last readable sweep."""
    timeline = Timeline.of(sequence)
    unreadable = dict(timeline.unknown)
    first = _readable(sequence, timeline.frames, unreadable)
    last = _readable(sequence, timeline.frames[::-1], unreadable)
    num_points = {sweep.frame: _num_points(sweep) for sweep in (first, last)}
    named = sorted(unreadable)[:_MOST_NAMED]
    lines = [
        ("name", sequence.name),
        ("frames", _frames(sequence)),
        ("rate", _hertz(timeline.stamp_ns) if len(timeline.frames) > 1 else "unknown, one sweep"),
        ("stamps", f"{first.stamp_ns} to {last.stamp_ns} ns ({_seconds(first, last):.2f} s)"),
        ("points", ", ".join(f"{num} in frame {f}" for f, num in num_points.items())),
        ("point times", _point_times(first)),
        *_cameras(sequence),
        ("poses", _poses(sequence, [f for f in timeline.frames if f not in unreadable])),
        ("truth", "none" if sequence.truth is None else "exact, simulated"),
        *(sequence.findings() if hasattr(sequence, "findings") else ()),
        *((f"frame {frame}", f"cannot be used: {unreadable[frame]}") for frame in named),
    ]
    if len(unreadable) > len(named):
        unlisted = format_frames(unreadable.keys() - named)
        lines.append(("frames", f"cannot be used either: {unlisted}"))
    return lines


def _readable(sequence: LidarSequence, frames: Sequence[int], unreadable: dict[int, str]) -> Sweep:
    """Return the first readable sweep of ``frames``; add reasons of failures to ``unreadable``."""
    for frame in (frame for frame in frames if frame not in unreadable):
        try:
            return sequence[frame]
        except InputError as error:
            unreadable[frame] = str(error)
    raise InputError(unreadable[frames[0]])


def _frames(sequence: LidarSequence) -> str:
    frames = sequence.frames
    num_missing = frames[-1] - frames[0] + 1 - len(frames)
    gaps = f", {num_missing} missing between them" if num_missing else ", no gaps"
    return f"{format_frames(frames)} ({len(frames)}{gaps})"


def _hertz(stamps_ns: Sequence[int] | Int) -> str:
    period_ns = sorted(np.diff(stamps_ns).tolist())[(len(stamps_ns) - 2) // 2]
    return f"{1e9 / period_ns:.2f} Hz" if period_ns > 0 else "unknown, stamps do not advance"


def _seconds(first: Sweep, last: Sweep) -> float:
    return (last.stamp_ns - first.stamp_ns) / 1e9


def _num_points(sweep: Sweep) -> str:
    untimed = f" ({sweep.num_untimed:,} more left out: their times are not of the sweep)"
    return f"{len(sweep):,}{untimed * bool(sweep.num_untimed)}"


def _point_times(first: Sweep) -> str:
    if first.offset_ns is None:
        return "none: sweeps cannot be deskewed from the data's own times"
    low_ms, high_ms = first.offset_ns.min() / 1e6, first.offset_ns.max() / 1e6
    return f"{low_ms:+.1f} to {high_ms:+.1f} ms around the stamp"


def _cameras(sequence: LidarSequence) -> list[tuple[str, str]]:
    if not sequence.cameras:
        return [("cameras", "none")]
    lines = []
    for name, camera in sequence.cameras.items():
        text = f"{camera.width_px} x {camera.height_px} px, fx {camera.focal_px:.1f} px, "
        text += "rectified" if camera.is_rectified else f"{camera.model} with lens distortion"
        if camera.is_rolling:
            text += f", rolling shutter of {camera.readout_s * 1e3:.1f} ms"
        exposed = sequence.image_stamps_ns(name)
        text += f", {len(exposed)} images: {format_frames(exposed)}"
        if len(exposed) > 1:
            text += f", {_hertz(list(exposed.values()))}"
        lines.append((name, text))
    return lines


def _poses(sequence: LidarSequence, frames: Sequence[int]) -> str:
    try:
        path = np.array([sequence.T_world_lidar(frame)[:3, 3] for frame in frames])
    except InputError as error:
        why = str(error).removeprefix(f"{getattr(sequence, 'where', None)}: ")
        return "none" if why.startswith("no poses") else f"none: {why}"
    length_m = np.linalg.norm(np.diff(path, axis=0), axis=1).sum()
    return f"yes, a path of {length_m:.1f} m"
