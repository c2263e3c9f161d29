# SPDX-License-Identifier: MIT
"""Read packets of a Velodyne scanner, a ``.pcap`` file, by velodyne-decoder (extra ``velodyne``).

Packets do not identify the model reliably; name it, as in ``velodyne:FILE.pcap#HDL-32E``. A sweep
is a turn that begins and ends straight behind the scanner, to the accuracy of a packet, stamped
when the computer captured its last packet. Incomplete turns at the ends are left out. ``offset_ns``
is computed from the packets' clock and the firing order of the model. Points are as measured, in
the scanner's frame: x forward (azimuth 0), y left, z up. There are no cameras and no poses.
"""

from __future__ import annotations

import struct
from collections.abc import Sequence
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np

from densify.config.errors import InputError
from densify.config.file_content import needed, open_file
from densify.geometry.types import Int
from densify.readers.file_sequence import FileSequence, Returns

MODELS = {
    "VLP-16": "VLP16",
    "Puck-Hi-Res": "PuckHiRes",
    "HDL-32E": "HDL32E",
    "VLP-32A": "VLP32A",
    "VLP-32B": "VLP32B",
    "VLP-32C": "VLP32C",
    "VLS-128": "VLS128",
}
"""Names of models in the decoder, by the names that users give."""

_PAYLOAD = 1206  # bytes of a packet with returns
_MAX_HEADERS = 64  # bytes of Ethernet, VLAN, IP and UDP headers before the packet
_FLAGS = (b"\xff\xee", b"\xff\xdd")  # first bytes of a packet with returns
_BEHIND = 18_000  # azimuth straight behind, hundredths of a degree
_HOUR_US = 3_600_000_000  # the packets' clock counts microseconds within the hour
_TWICE_NS = 10**9  # a packet of the same direction and time comes again after an hour at least
_WHOLE = 0.9  # smallest share of the usual packets in a complete turn
_PCAP = {  # magic number -> byte order, nanoseconds per unit of the fraction
    b"\xd4\xc3\xb2\xa1": ("<", 1000),
    b"\xa1\xb2\xc3\xd4": (">", 1000),
    b"\x4d\x3c\xb2\xa1": ("<", 1),
    b"\xa1\xb2\x3c\x4d": (">", 1),
}


def open_recording(path: Path, scene: str | None) -> Velodyne:
    """Open a ``.pcap`` capture; ``scene`` is the scanner's model, one of `MODELS`."""
    if scene not in MODELS:
        got = "no model" if scene is None else f"the model {scene}"
        raise InputError(
            f"{path}: got {got}; name the Velodyne by velodyne:{path}#MODEL, MODEL one of "
            f"{', '.join(MODELS)} (an Ouster's capture needs its metadata .json beside it)"
        )
    return Velodyne(path, scene)


class Velodyne(FileSequence):
    """A Velodyne capture as a `LidarSequence`, stamped at the last packet of each sweep."""

    def __init__(self, path: Path, model: str) -> None:
        self._library = needed("velodyne_decoder", "velodyne", "Velodyne captures")
        self._model = getattr(self._library.Model, MODELS[model])
        packets, self._num_twice = _once(_find_packets(path))
        self._begin, self._captured_ns, azimuth, clock_us = packets
        self._num_packets, self._num_lost = len(azimuth), _num_lost(clock_us)
        self._turns = _turns(azimuth)
        if not self._turns:
            raise InputError(
                f"{path}: no whole turn: got {len(azimuth)} packets of returns, expected those of "
                f"a tenth of a second or more"
            )
        self._stamps_ns = [int(self._captured_ns[turn.stop - 1]) for turn in self._turns]
        super().__init__(path.stem, path, range(len(self._turns)))

    def findings(self) -> Sequence[tuple[str, str]]:
        """Return the number of packets, and of those that are lost or were captured twice."""
        share = 100 * self._num_lost / (self._num_packets + self._num_lost)
        text = f"{self._num_packets:,}, {self._num_lost:,} lost ({share:.1f} %)"
        return [("packets", f"{text}, {self._num_twice:,} captured twice and read once")]

    def _returns(self, frame: int) -> Returns:
        library, packets = self._library, []
        with open_file(self.where) as file:
            for row in self._turns[frame]:
                file.seek(int(self._begin[row]))
                captured_s = float(self._captured_ns[row] * 1e-9)
                packets.append(library.VelodynePacket(captured_s, file.read(_PAYLOAD)))
        try:
            decoder = library.ScanDecoder(library.Config(model=self._model))
            columns: Any = decoder.decode(library.PacketVector(packets))[1]
        except (RuntimeError, ValueError, TypeError) as error:
            raise InputError(
                f"{self.where}: frame {frame} cannot be decoded: {error}; is it another model?"
            ) from error
        x, y, z, intensity, time_s = columns[:, :5].T
        return Returns(
            np.column_stack([x, y, z]).astype(np.float64),
            (intensity / 255).astype(np.float32),
            np.rint(time_s.astype(np.float64) * 1e9).astype(np.int64),
        )


def _find_packets(path: Path) -> Int:
    """Return offset, capture time (ns), azimuth (0.01 deg) and clock (us) of packets, (4,P)."""
    packets = []
    with open_file(path) as file:
        magic = file.read(24)[:4]
        if magic not in _PCAP:
            raise InputError(
                f"{path}: not a capture of packets: it does not begin as a .pcap; a .pcapng "
                f"becomes one with editcap -F pcap"
            )
        order, unit_ns = _PCAP[magic]
        record, at = struct.Struct(f"{order}IIII"), 24
        while len(head := file.read(record.size)) == record.size:
            seconds, fraction, size, _ = record.unpack(head)
            at += record.size + size
            if not _PAYLOAD < size <= _PAYLOAD + _MAX_HEADERS:
                file.seek(at)
                continue
            payload = file.read(size)[size - _PAYLOAD :]
            if len(payload) < _PAYLOAD:
                break  # cut off
            if payload[:2] in _FLAGS:
                azimuth = payload[2] + 256 * payload[3]
                (clock_us,) = struct.unpack_from("<I", payload, _PAYLOAD - 6)
                captured_ns = seconds * 10**9 + fraction * unit_ns
                packets.append((at - _PAYLOAD, captured_ns, azimuth, clock_us))
    if not packets:
        raise InputError(
            f"{path}: no Velodyne packets (of {_PAYLOAD} bytes); is it an Ouster's? Then put its "
            f"metadata .json beside it"
        )
    return np.array(packets, np.int64).T


def _once(packets: Int) -> tuple[Int, int]:
    """Return packets (4,P) without those captured a second time, and the number of these."""
    _, captured_ns, azimuth, clock_us = packets
    order = np.lexsort((captured_ns, azimuth, clock_us))
    # Rows 2 and 3: azimuth and clock
    same = (np.diff(packets[2:, order]) == 0).all(axis=0)
    twice = np.concatenate([[False], same & (np.diff(captured_ns[order]) < _TWICE_NS)])
    kept = np.sort(order[~twice])
    return packets[:, kept], int(twice.sum())


def _num_lost(clock_us: Int) -> int:
    """Return the number of packets missing between others, from their clock (P,)."""
    step_us = np.diff(clock_us) % _HOUR_US
    step_us = step_us[step_us > 0]  # two packets of a dual return have one time
    if not len(step_us):
        return 0
    return int(np.maximum(np.rint(step_us / np.median(step_us)) - 1, 0).sum())


def _turns(azimuth: Int) -> list[range]:
    """Return the packet indices of each complete turn, from azimuths (P,) in 0.01 degrees."""
    from_behind = (azimuth - _BEHIND) % 36_000
    first = [0, *(np.flatnonzero(np.diff(from_behind) < -_BEHIND) + 1).tolist(), len(azimuth)]
    turns = [range(a, b) for a, b in pairwise(first)]
    usual = np.median([len(turn) for turn in turns[1:-1] or turns])
    ends = {turns[0], turns[-1]}
    return [turn for turn in turns if turn not in ends or len(turn) >= _WHOLE * usual]
