# SPDX-License-Identifier: MIT
"""Open and describe recordings. `densify.config.plugins` has the table of readers."""

from __future__ import annotations

import os
from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple, Protocol

import numpy as np

from densify.config.errors import InputError, did_you_mean
from densify.config.plugins import READERS, Plugin
from densify.geometry.types import Int, LidarSequence, Sweep
from densify.readers.checks import drive_around
from densify.readers.file_sequence import FileSequence
from densify.readers.timeline import Timeline, format_frames

_MOST_ENTRIES = 200  # files and folders searched inside a folder that is no recording
_MOST_NAMED = 3  # most unusable sweeps that are listed with a reason


class ReaderModule(Protocol):
    """Interface of a reader's module, which also has the ``recognises`` of `Plugin`."""

    def open_recording(self, path: Path, scene: str | None) -> LidarSequence:
        """Return the recording at a path, or its part ``scene``, the text after ``#``."""
        ...


class Spec(NamedTuple):
    """The parts of a recording's specification, as given to ``--data``."""

    # Name in `READERS`; "street" for the simulated recording; None to recognise the files
    reader: str | None
    place: str  # path as typed by the user; for the street, the whole text with its options
    scene: str | None = None  # scene name or reader's option after ``#``

    @staticmethod
    def parse(text: str | Path) -> Spec:
        """Return the parts of a text ``street[:PRESET][?...]`` or ``[READER:]PATH[#SCENE]``.

        A word before a colon is a reader only if a reader has this name. A ``#`` in the path of an
        existing file is a part of the path.
        """
        text = str(text)
        if text == "street" or text.startswith(("street:", "street?")):
            return Spec("street", text)
        name, colon, location = text.partition(":")
        reader = name if colon and name in READERS.names() else None
        location = text if reader is None else location
        # Without READER:, a # also belongs to the path if the text before the # names no file.
        path, mark, scene = location.rpartition("#")
        if not mark or _exists(location) or (reader is None and not _exists(path)):
            return Spec(reader, location)
        return Spec(reader, path, scene)

    @property
    def path(self) -> Path:
        """Path with a leading ``~`` expanded, which shells do not do after ``READER:``."""
        return Path(self.place).expanduser()

    def absolute(self) -> str:
        """Return the text of the spec with an absolute path, valid in any working directory."""
        if self.reader == "street":
            return self.place
        reader = "" if self.reader is None else f"{self.reader}:"
        scene = "" if self.scene is None else f"#{self.scene}"
        return f"{reader}{self.path.absolute()}{scene}"


def _exists(location: str) -> bool:
    return os.path.exists(Path(location).expanduser())


def open_sequence(spec: str | Path = "street") -> LidarSequence:
    """Return a recording whose sweeps and images are read later, on demand.

    Args:
        spec: A path, ``READER:PATH[#SCENE]``, or ``street[:PRESET][?seed=N&sensor=NAME]`` for the
            built-in simulated street. Without ``READER:`` the reader is recognised by the files.

    Raises:
        InputError: No reader recognises the files, the scene is unknown, or files are damaged.
    """
    parsed = Spec.parse(spec)
    if parsed.reader == "street":
        from densify.readers.street import Street

        return Street.from_spec(parsed.place)
    reader = _reader_of(parsed, f"data {spec}")
    if parsed.scene is not None and not reader.scenes:
        raise InputError(
            f"data {spec}: {reader.name} recordings have no scenes; leave #{parsed.scene} out"
        )
    module: ReaderModule = reader.load_module()
    sequence = module.open_recording(parsed.path, parsed.scene)
    if isinstance(sequence, FileSequence):
        sequence.check_first_images()
    return sequence


def _reader_of(parsed: Spec, where: str) -> Plugin:
    """Return the named reader, or the first reader that recognises the path."""
    if parsed.reader is not None:
        return READERS.plugin(parsed.reader, where)
    if not parsed.path.exists():
        name, _, _ = parsed.place.partition(":")
        hint = did_you_mean(name, [*READERS.names(), "street"])
        raise InputError(
            f"{where}: no such folder; {hint}expected a recording's folder, READER:PATH with "
            f"READER one of {', '.join(READERS.names())}, or street[:PRESET]"
        )
    readers = list(READERS)
    for reader in readers:
        if reader.recognises(parsed.path):
            return reader
    # A recording inside, at most two levels down. Links may lead nowhere.
    entries = [*parsed.path.glob("*"), *parsed.path.glob("*/*")][:_MOST_ENTRIES]
    entries = sorted(entry for entry in entries if entry.exists())
    for reader in readers:
        for entry in entries:
            if reader.recognises(entry):
                raise InputError(f"{where}: no recording itself; one in it is {entry}: name that")
    raise InputError(
        f"{where}: no recording: {_what_is_there(parsed.path)}; expected one of the readers "
        f"{', '.join(reader.name for reader in readers)} (densify info --help says what each reads)"
    )


def _what_is_there(path: Path) -> str:
    """Describe the contents of a path without a recording, as a clause for error messages."""
    if path.is_file():
        return f"it is a {path.suffix or 'file without a suffix'} file"
    counts = Counter(entry.suffix.lower() or "other" for entry in path.iterdir() if entry.is_file())
    kinds = [(f"{suffix} file", count) for suffix, count in counts.most_common(3)]
    kinds.append(("folder", sum(entry.is_dir() for entry in path.iterdir())))
    contents = ", ".join(f"{count} {kind}{'s' * (count > 1)}" for kind, count in kinds if count)
    text = f"it holds {contents}, no lidar sweeps" if contents else "it is empty"
    drive = drive_around(path)
    return text if drive is None else f"{text}, and is inside a KITTI drive: give {drive}"


def describe(sequence: LidarSequence) -> str:
    """Return a summary of a recording as text, with a line for each pair of `findings`."""
    return align(findings(sequence))


def align(lines: Sequence[tuple[str, str]]) -> str:
    """Return (name, text) pairs as lines of text, where all texts start in the same column."""
    width = max(len(label) for label, _ in lines) + 2
    return "\n".join(f"{label:<{width}}{text}" for label, text in lines)


def findings(sequence: LidarSequence) -> list[tuple[str, str]]:
    """Return a recording's summary as (name, text) pairs for people.

    The pairs give frames, rate, stamps, points, cameras, poses, truth and the reader's findings.
    Points and stamps are those of the first and the last readable sweep. Raise InputError if no
    sweep is readable.
    """
    timeline = Timeline.of(sequence)
    unreadable = dict(timeline.unknown)
    first_sweep = _readable(sequence, timeline.frames, unreadable)
    last_sweep = _readable(sequence, timeline.frames[::-1], unreadable)
    num_points = {sweep.frame: _num_points(sweep) for sweep in (first_sweep, last_sweep)}
    named_frames = sorted(unreadable)[:_MOST_NAMED]
    begin_ns, end_ns = first_sweep.stamp_ns, last_sweep.stamp_ns
    frames = sequence.frames
    num_missing = frames[-1] - frames[0] + 1 - len(frames)
    gaps = f"{num_missing} missing between them" if num_missing else "no gaps"
    lines = [
        ("name", sequence.name),
        ("frames", f"{format_frames(frames)} ({len(frames)}, {gaps})"),
        ("rate", _hertz(timeline.stamp_ns) if len(timeline.frames) > 1 else "unknown, one sweep"),
        ("stamps", f"{begin_ns} to {end_ns} ns ({(end_ns - begin_ns) * 1e-9:.2f} s)"),
        ("points", ", ".join(f"{num} in frame {f}" for f, num in num_points.items())),
        ("point times", _point_times(first_sweep)),
        *_cameras(sequence),
        ("poses", _poses(sequence, [f for f in timeline.frames if f not in unreadable])),
        ("truth", "none" if sequence.truth is None else "exact, simulated"),
    ]
    if hasattr(sequence, "findings"):
        lines += sequence.findings()
    for frame in named_frames:
        lines.append((f"frame {frame}", f"cannot be used: {unreadable[frame]}"))
    if len(unreadable) > len(named_frames):
        unlisted = format_frames(unreadable.keys() - named_frames)
        lines.append(("frames", f"cannot be used either: {unlisted}"))
    return lines


def _readable(sequence: LidarSequence, frames: Sequence[int], unreadable: dict[int, str]) -> Sweep:
    """Return the first readable sweep of ``frames``, and note failures in ``unreadable``."""
    for frame in frames:
        if frame in unreadable:
            continue
        try:
            return sequence[frame]
        except InputError as error:
            unreadable[frame] = str(error)
    raise InputError(unreadable[frames[0]])


def _hertz(stamps_ns: Sequence[int] | Int) -> str:
    """Describe the rate of two or more stamps, by the lower median of their steps."""
    steps_ns = sorted(np.diff(stamps_ns).tolist())
    period_ns = steps_ns[(len(steps_ns) - 1) // 2]
    return f"{1e9 / period_ns:.2f} Hz" if period_ns > 0 else "unknown, stamps do not advance"


def _num_points(sweep: Sweep) -> str:
    """Describe the number of points, and of points left out for their time."""
    untimed = f" ({sweep.num_untimed:,} more left out: their times are not of the sweep)"
    return f"{len(sweep):,}{untimed * bool(sweep.num_untimed)}"


def _point_times(first: Sweep) -> str:
    """Describe the range of the firing times of a sweep."""
    if first.offset_ns is None:
        return "none: sweeps cannot be deskewed from the data's own times"
    low_ms, high_ms = first.offset_ns.min() / 1e6, first.offset_ns.max() / 1e6
    return f"{low_ms:+.1f} to {high_ms:+.1f} ms around the stamp"


def _cameras(sequence: LidarSequence) -> list[tuple[str, str]]:
    """Return the name and the description of each camera."""
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
    """Describe the length of the recorded path, or the reason why there are no poses."""
    try:
        path = np.array([sequence.T_world_lidar(frame)[:3, 3] for frame in frames])
    except InputError as error:
        why = str(error).removeprefix(f"{getattr(sequence, 'where', None)}: ")
        # That a reader has no poses is no news, and its remedy does not belong into a summary.
        return "none" if why.startswith("no poses") else f"none: {why}"
    length_m = np.linalg.norm(np.diff(path, axis=0), axis=1).sum()
    return f"yes, a path of {length_m:.1f} m"
