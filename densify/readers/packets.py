# SPDX-License-Identifier: MIT
"""Read packets of a scanner, captured in a ``.pcap`` file, by the decoders of other packages.

Velodyne (extra ``velodyne``): the packets do not identify the model reliably; name it, as in
``velodyne:FILE.pcap#HDL-32E``. A sweep is a turn that begins and ends straight behind the scanner,
to the accuracy of a packet, stamped when the computer captured its last packet. Incomplete turns at
the ends are left out. ``offset_ns`` is computed from the packets' clock and the firing order.

Ouster (extra ``ouster``): the ``.json`` metadata of the sensor is named after ``#``, or is found
beside the capture. A sweep is a frame of the sensor, stamped when the computer captured its first
packet. The sensor's clock gives the firing times of columns since the first. Rays start on the
spinning axis, the origin is on the base. Rows follow the range image. Of two returns of a ray the
first is read.

Points are as measured, in the scanner's frame: x forward, y left, z up. There are no cameras and no
poses.
"""

from __future__ import annotations

import struct
import warnings
from collections.abc import Sequence
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np

from densify.config.errors import InputError
from densify.config.file_content import import_extra, open_file, read_json, reason
from densify.geometry.types import Int
from densify.readers.file_sequence import FileSequence, Returns

MODELS = ("VLP-16", "Puck-Hi-Res", "HDL-32E", "VLP-32A", "VLP-32B", "VLP-32C", "VLS-128")
"""Velodyne's models; the decoder's names of them have no hyphens."""

_PAYLOAD = 1206  # bytes of a Velodyne packet with returns
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
_HALF_WRAP = 1 << 15  # Ouster's packets count turns with 16 bits


def open_recording(path: Path, scene: str | None) -> FileSequence:
    """Return a ``.pcap`` capture. ``scene`` is a Velodyne's model or an Ouster's metadata file."""
    if not path.is_file():
        raise InputError(f"{path}: no such file; expected a capture of packets (.pcap)")
    if scene in MODELS:
        return Velodyne(path, scene)
    metadata = _find_metadata(path) if scene is None else path.with_name(scene)
    if metadata is not None and metadata.is_file():
        return Ouster(path, metadata)
    got = "no model and no metadata" if scene is None else f"the model or metadata {scene}"
    names = ", ".join(sorted(p.name for p in path.parent.glob("*.json"))) or "none"
    raise InputError(
        f"{path}: got {got}; name the Velodyne by velodyne:{path}#MODEL, MODEL one of "
        f"{', '.join(MODELS)}, or put an Ouster's metadata .json beside it (there: {names}) and "
        f"name it by ouster:{path}#NAME.json if there are several"
    )


def _find_metadata(path: Path) -> Path | None:
    """Return the .json of a capture by their common begin, else the only one, else None."""
    json_files = sorted(path.parent.glob("*.json"))
    named = [p for p in json_files if path.stem.startswith(p.stem)]
    if named:
        return max(named, key=lambda p: len(p.stem))
    return json_files[0] if len(json_files) == 1 else None


def _packet_counts(num_read: int, num_lost: int, num_twice: int) -> Sequence[tuple[str, str]]:
    """Return the numbers of packets read, lost, and captured twice, as one (name, text) pair."""
    lost_percent = 100 * num_lost / (num_read + num_lost)
    text = f"{num_read:,}, {num_lost:,} lost ({lost_percent:.1f} %)"
    return [("packets", f"{text}, {num_twice:,} captured twice and read once")]


class Velodyne(FileSequence):
    """A Velodyne capture as a `LidarSequence`, stamped at the last packet of each sweep."""

    def __init__(self, path: Path, model: str) -> None:
        self._library = import_extra("velodyne_decoder", "velodyne", "Velodyne captures")
        self._model = getattr(self._library.Model, model.replace("-", ""))
        packets, num_twice = _once(_find_packets(path))
        self._begin, self._captured_ns, azimuth, clock_us = packets
        self._packet_counts = len(azimuth), _num_lost(clock_us), num_twice
        self._turns = _turns(azimuth)
        self._stamps_ns = [int(self._captured_ns[turn.stop - 1]) for turn in self._turns]
        super().__init__(path.stem, path, range(len(self._turns)))

    def findings(self) -> Sequence[tuple[str, str]]:
        """Return one pair: "packets", and the numbers of packets read, lost and captured twice."""
        return _packet_counts(*self._packet_counts)

    def _returns(self, frame: int) -> Returns:
        """Decode the packets of a turn into its returns."""
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
        offset_ns = np.rint(columns[:, 4].astype(np.float64) * 1e9).astype(np.int64)
        intensity = (columns[:, 3] / 255).astype(np.float32)
        return Returns(columns[:, :3].astype(np.float64), intensity, offset_ns)


def _find_packets(path: Path) -> Int:
    """Return the packets' (4,P) file offset, capture time (ns), azimuth (0.01 deg), clock (us)."""
    packets = []
    with open_file(path) as file:
        magic = file.read(24)[:4]
        if magic not in _PCAP:
            raise InputError(
                f"{path}: not a capture of packets: it does not begin as a .pcap; a .pcapng "
                f"becomes one with editcap -F pcap"
            )
        order, unit_ns = _PCAP[magic]
        record = struct.Struct(f"{order}IIII")
        end = 24  # end of the file header, then of each record
        while len(head := file.read(record.size)) == record.size:
            seconds, fraction, size, _ = record.unpack(head)
            end += record.size + size
            if not _PAYLOAD < size <= _PAYLOAD + _MAX_HEADERS:
                file.seek(end)
                continue
            payload = file.read(size)[size - _PAYLOAD :]
            if len(payload) < _PAYLOAD:
                break  # cut off
            if payload[:2] in _FLAGS:
                azimuth = payload[2] + 256 * payload[3]
                (clock_us,) = struct.unpack_from("<I", payload, _PAYLOAD - 6)
                captured_ns = seconds * 10**9 + fraction * unit_ns
                packets.append((end - _PAYLOAD, captured_ns, azimuth, clock_us))
    if not packets:
        raise InputError(
            f"{path}: no Velodyne packets (of {_PAYLOAD} bytes); is it an Ouster's? Then put its "
            f"metadata .json beside it"
        )
    return np.array(packets, np.int64).T


def _once(packets: Int) -> tuple[Int, int]:
    """Return the packets (4,P) without second captures, and the number of second captures."""
    _, captured_ns, azimuth, clock_us = packets
    # Captures of one packet are neighbours in this order.
    order = np.lexsort((captured_ns, azimuth, clock_us))
    same = (np.diff(azimuth[order]) == 0) & (np.diff(clock_us[order]) == 0)
    twice = np.concatenate([[False], same & (np.diff(captured_ns[order]) < _TWICE_NS)])
    return packets[:, np.sort(order[~twice])], int(twice.sum())


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
    starts = (np.flatnonzero(np.diff(from_behind) < -_BEHIND) + 1).tolist()
    turns = [range(begin, end) for begin, end in pairwise([0, *starts, len(azimuth)])]
    usual_length = np.median([len(turn) for turn in turns[1:-1] or turns])
    ends = {turns[0], turns[-1]}  # the capture may begin and end within a turn
    return [turn for turn in turns if turn not in ends or len(turn) >= _WHOLE * usual_length]


class Ouster(FileSequence):
    """An Ouster capture as a `LidarSequence`, stamped at the first packet of each sweep."""

    def __init__(self, path: Path, metadata: Path) -> None:
        core = import_extra("ouster.sdk.core", "ouster", "Ouster captures")
        pcap = import_extra("ouster.sdk.pcap", "ouster", "Ouster captures")
        read_json(metadata)
        open_file(path).close()  # raises a clear error for an unreadable file
        try:
            self._source = pcap.PcapFrameSetSource(str(path), meta=[str(metadata)], index=True)
            index, sensor = self._source.individual_index[0], self._source.sensor_info[0]
            self._table = core.XYZLut(sensor)
        except Exception as error:  # the library raises many types
            raise InputError(
                f"{path}: cannot be decoded with {metadata.name}: {reason(error)}; expected a "
                f".pcap of an Ouster and the metadata of the same sensor"
            ) from error
        if not len(index):
            raise InputError(
                f"{path}: no sweeps of the sensor that {metadata.name} describes; name its own "
                f"metadata by ouster:{path}#NAME.json"
            )
        self._stamps_ns = index[:, 0].astype(np.int64) * 1000
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # the library warns of deprecated names
            T = np.asarray(sensor.lidar_to_sensor_transform, np.float64)
        self._origins_m = T[None, :3, 3] * 1e-3
        self._packets: Any = pcap.PcapPacketSource(str(path), meta=[str(metadata)])
        self._is_lidar_packet = core.LidarPacket
        self._column = core.ColHeader.MEASUREMENT_ID
        super().__init__(path.stem, path, range(len(index)))

    def findings(self) -> Sequence[tuple[str, str]]:
        """Return one pair: "packets", and the numbers of packets read, lost and captured twice."""
        packets = [p for _, p in self._packets if isinstance(p, self._is_lidar_packet)]
        turn = np.array([p.frame_id() for p in packets], np.int64)
        column = np.array([p.format.packet_header(self._column, p.buf)[0] for p in packets], int)
        num_lost, num_twice = count_lost_and_repeated(turn, column)
        return _packet_counts(len(packets) - num_twice, num_lost, num_twice)

    def _returns(self, frame: int) -> Returns:
        """Decode a frame of the sensor, and time each column since the first measured one."""
        try:
            scan = self._source[frame][0]
            points = np.asarray(self._table(scan), np.float64)
        except Exception as error:  # the library raises many types
            raise InputError(
                f"{self.where}: frame {frame} cannot be decoded: {reason(error)}; choose a key or "
                f"window without it"
            ) from error
        measured = (scan.status & 1).astype(bool)
        points[:, ~measured] = 0
        since_ns = np.zeros(scan.w, np.int64)
        if measured.any():
            column_ns = scan.timestamp.astype(np.int64)[measured]
            since_ns[measured] = column_ns - column_ns.min()
        offset_ns = np.broadcast_to(since_ns, (scan.h, scan.w)).reshape(-1)
        intensity = None
        if scan.has_field("REFLECTIVITY"):
            intensity = np.clip(scan.field("REFLECTIVITY") / 255, 0, 1).astype(np.float32).ravel()
        points, origins = points.reshape(-1, 3), self._origins_m
        return Returns(points, intensity, offset_ns, scanner_origins=origins)


def count_lost_and_repeated(turn: Int, column: Int) -> tuple[int, int]:
    """Return the number of packets missing between P others, and of repeated captures.

    ``turn`` (P,) numbers each packet's turn with 16 bits: 0 follows 65535.
    ``column`` (P,) is the first column of each packet.
    """
    # Steps of the counter are unwrapped, then every packet of the sensor has a number of its own.
    step = np.diff(turn, prepend=turn[:1])
    turn = np.cumsum((step + _HALF_WRAP) % (2 * _HALF_WRAP) - _HALF_WRAP)
    sent_columns, rank = np.unique(column, return_inverse=True)
    number = np.unique(turn * len(sent_columns) + rank)
    return int(np.ptp(number)) + 1 - len(number), len(turn) - len(number)
