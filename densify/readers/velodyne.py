# SPDX-License-Identifier: MIT
"""Read packets of a Velodyne scanner, a ``.pcap`` file, by velodyne-decoder.

It needs the extra ``velodyne``. The packets do not tell the model reliably: name it, as in
``velodyne:FILE.pcap#HDL-32E``.

A sweep is a turn that begins and ends straight behind, to a packet, numbered from 0, decoded on
demand. Turns cut off at the ends of the file are left out. The stamp is the computer's, of the last
packet. ``offset_ns`` is from the packets' clock and the firing order of the model. Points are as
measured, in the scanner's frame: x forward (azimuth 0), y left, z up. There are neither cameras nor
poses.
"""

from __future__ import annotations

import struct
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
"""A user's name of a model, and the decoder's."""

_PAYLOAD = 1206  # bytes of a packet of returns
_MAX_HEADERS = 64  # bytes before it: Ethernet, perhaps a VLAN's, IP, UDP
_FLAGS = (b"\xff\xee", b"\xff\xdd")  # that it begins with
_BEHIND = 18_000  # hundredths of a degree
_WHOLE = 0.9  # of the usual number of packets
_PCAP = {  # magic number -> byte order, nanoseconds per unit of the fraction
    b"\xd4\xc3\xb2\xa1": ("<", 1000),
    b"\xa1\xb2\xc3\xd4": (">", 1000),
    b"\x4d\x3c\xb2\xa1": ("<", 1),
    b"\xa1\xb2\x3c\x4d": (">", 1),
}


def open_recording(path: Path, scene: str | None) -> Velodyne:
    """See `densify.readers.ReaderModule`.

    Args:
        path: The capture.
        scene: The model.
    """
    if scene not in MODELS:
        got = "no model" if scene is None else f"the model {scene}"
        raise InputError(
            f"{path}: got {got}; name the Velodyne by velodyne:{path}#MODEL, MODEL one of "
            f"{', '.join(MODELS)} (an Ouster's capture needs its metadata .json beside it)"
        )
    return Velodyne(path, scene)


class Velodyne(FileSequence):
    """A capture as a `LidarSequence`. The stamp of a sweep is the capture of its last packet."""

    def __init__(self, path: Path, model: str) -> None:
        """Open a capture.

        Args:
            model: A row of `MODELS`.

        Raises:
            InputError: The file is no capture, or holds less than one turn.
        """
        self._library = needed("velodyne_decoder", "velodyne", "Velodyne captures")
        self._model = getattr(self._library.Model, MODELS[model])
        self._begin, self._captured_ns, azimuth = _find_packets(path)
        self._turns = _turns(azimuth)
        if not self._turns:
            raise InputError(
                f"{path}: no whole turn: got {len(azimuth)} packets of returns, expected those of "
                f"a tenth of a second or more"
            )
        self._stamps_ns = [int(self._captured_ns[turn.stop - 1]) for turn in self._turns]
        super().__init__(path.stem, path, range(len(self._turns)))

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


def _find_packets(path: Path) -> tuple[Int, Int, Int]:
    """Return the (P,) packets of returns.

    Returns of each the position of its payload, its capture time (ns), and the azimuth of its first
    firing (hundredths of a degree).
    """
    found = []
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
                found.append((at - _PAYLOAD, seconds * 10**9 + fraction * unit_ns, azimuth))
    if not found:
        raise InputError(
            f"{path}: no Velodyne packets (of {_PAYLOAD} bytes); is it an Ouster's? Then put its "
            f"metadata .json beside it"
        )
    begin, captured_ns, azimuths = np.array(found, np.int64).T
    return begin, captured_ns, azimuths


def _turns(azimuth: Int) -> list[range]:
    """Return the packets of each whole turn."""
    from_behind = (azimuth - _BEHIND) % 36_000
    first = [0, *(np.flatnonzero(np.diff(from_behind) < -_BEHIND) + 1).tolist(), len(azimuth)]
    turns = [range(a, b) for a, b in pairwise(first)]
    usual = np.median([len(turn) for turn in turns[1:-1] or turns])
    ends = {turns[0], turns[-1]}
    return [turn for turn in turns if turn not in ends or len(turn) >= _WHOLE * usual]
