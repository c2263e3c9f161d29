# SPDX-License-Identifier: MIT
"""Read packets (.pcap) of an Ouster scanner by the maker's ouster-sdk (extra ``ouster``).

The ``.json`` metadata of the sensor is named after ``#``, or found by `find_metadata`. A sweep is a
frame of the sensor, numbered from 0; its stamp is when the computer captured its first packet. The
sensor's clock gives the firing times of columns since the first. Points are as measured, in the
sensor's frame (x forward, y left, z up, origin on the base); rays start on the spinning axis. Rows
follow the range image, row by row. Of two returns of a ray the first is read. There are no cameras
and no poses.
"""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from densify.config.errors import InputError
from densify.config.file_content import needed, open_file, read_json, reason
from densify.geometry.types import Int
from densify.readers.file_sequence import FileSequence, Returns

_HALF_WRAP = 1 << 15  # the packets count turns with 16 bits


def open_recording(path: Path, scene: str | None) -> Ouster:
    """Open a ``.pcap`` capture; ``scene`` names the metadata beside it, None to find it."""
    if not path.is_file():
        raise InputError(f"{path}: no such file; expected an Ouster capture (.pcap)")
    metadata = find_metadata(path) if scene is None else path.with_name(scene)
    if metadata is None or not metadata.is_file():
        names = ", ".join(sorted(p.name for p in path.parent.glob("*.json"))) or "none"
        raise InputError(
            f"{path}: which metadata? beside it: {names}; put the sensor's .json there, name it by "
            f"ouster:{path}#NAME.json if there are several"
        )
    return Ouster(path, metadata)


def find_metadata(path: Path) -> Path | None:
    """Return the metadata file in the folder of a capture; None if the choice is not clear.

    The file with the longest name that begins the name of the capture is chosen, or else the only
    ``.json`` file.
    """
    json_files = sorted(path.parent.glob("*.json"))
    named = [p for p in json_files if path.stem.startswith(p.stem)]
    if named:
        return max(named, key=lambda p: len(p.stem))
    return json_files[0] if len(json_files) == 1 else None


class Ouster(FileSequence):
    """An Ouster capture as a `LidarSequence`, stamped at the first packet of each sweep."""

    def __init__(self, path: Path, metadata: Path) -> None:
        core = needed("ouster.sdk.core", "ouster", "Ouster captures")
        pcap = needed("ouster.sdk.pcap", "ouster", "Ouster captures")
        read_json(metadata)
        open_file(path).close()  # raises a clear error for an unreadable file
        try:
            self._source = pcap.PcapFrameSetSource(str(path), meta=[str(metadata)], index=True)
            index = self._source.individual_index[0]
            self._table = core.XYZLut(self._source.sensor_info[0])
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
            T = np.asarray(self._source.sensor_info[0].lidar_to_sensor_transform, np.float64)
        self._origins_m = T[None, :3, 3] * 1e-3
        self._packets: Any = pcap.PcapPacketSource(str(path), meta=[str(metadata)])
        self._is_lidar_packet = core.LidarPacket
        self._column = core.ColHeader.MEASUREMENT_ID
        super().__init__(path.stem, path, range(len(index)))

    def findings(self) -> Sequence[tuple[str, str]]:
        """Return the number of packets, and of those that are lost or were captured twice."""
        packets = [p for _, p in self._packets if isinstance(p, self._is_lidar_packet)]
        turn = np.array([p.frame_id() for p in packets], np.int64)
        column = [int(p.format.packet_header(self._column, p.buf)[0]) for p in packets]
        num_lost, num_twice = lost_and_doubled(turn, np.array(column, np.int64))
        num = len(packets) - num_twice
        text = f"{num:,}, {num_lost:,} lost ({100 * num_lost / (num + num_lost):.1f} %)"
        return [("packets", f"{text}, {num_twice:,} captured twice and read once")]

    def _returns(self, frame: int) -> Returns:
        try:
            scan = self._source[frame][0]
            points = np.asarray(self._table(scan), np.float64)
        except Exception as error:  # the library raises many types
            raise InputError(
                f"{self.where}: frame {frame} cannot be decoded: {reason(error)}; choose a key or "
                f"window without it"
            ) from error
        measured = (scan.status & 1).astype(bool)
        since_ns = np.zeros(scan.w, np.int64)
        if measured.any():
            column_ns = scan.timestamp.astype(np.int64)
            since_ns[measured] = column_ns[measured] - column_ns[measured].min()
        points[:, ~measured] = 0
        intensity = np.zeros((scan.h, scan.w))
        if scan.has_field("REFLECTIVITY"):
            intensity = np.clip(scan.field("REFLECTIVITY") / 255, 0, 1)
        return Returns(
            points.reshape(-1, 3),
            intensity.astype(np.float32).reshape(-1),
            np.broadcast_to(since_ns, (scan.h, scan.w)).reshape(-1),
            scanner_origins=self._origins_m,
        )


def lost_and_doubled(turn: Int, column: Int) -> tuple[int, int]:
    """Return the number of packets missing between others, and of those captured a second time.

    Args:
        turn: (P,) number of the turn of each packet, which wraps at 16 bits.
        column: (P,) number of the first column of each packet. A sensor with a limited azimuth
            sends some columns only.
    """
    step = np.diff(turn, prepend=turn[:1])
    turn = np.cumsum((step + _HALF_WRAP) % (2 * _HALF_WRAP) - _HALF_WRAP)
    sent_columns, rank = np.unique(column, return_inverse=True)
    number = np.unique(turn * len(sent_columns) + rank)
    return int(np.ptp(number)) + 1 - len(number), len(turn) - len(number)
