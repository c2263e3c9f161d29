# SPDX-License-Identifier: MIT
"""The readers of packets, Velodyne's and Ouster's: captures written here by the manual, broken
ones, and real ones."""

from __future__ import annotations

import struct
import sys

import numpy as np
import pytest

from densify.config.errors import InputError
from densify.free_space.sensor import find_rings
from densify.readers import open_sequence
from densify.readers.packets import MODELS, Ouster, Velodyne, count_lost_and_repeated
from tests.reader_checks import check_refused

HEADERS = bytes(42)  # Ethernet, IP, UDP: not looked at
START_S, PACKET_US, PACKETS_PER_TURN = 1_355_263_594, 1327, 76
RANGE_M = 10.0


def vlp16_payload(azimuth_cdeg: int, since_us: int) -> bytes:
    """Twelve blocks of two firings of 16 lasers, as VLP-16's manual 63-9243 has them (9.3), all
    meeting something at `RANGE_M` (units of 2 mm) of intensity 100."""
    step = 36_000 / PACKETS_PER_TURN / 12
    blocks = b"".join(
        struct.pack("<HH", 0xEEFF, int(azimuth_cdeg + i * step) % 36_000)
        + struct.pack("<HB", int(RANGE_M * 500), 100) * 32
        for i in range(12)
    )
    return blocks + struct.pack("<IBB", since_us, 0x37, 0x22)  # strongest return, VLP-16


def records(num_turns: float, order: str = "<", magic: int = 0xA1B2C3D4) -> list[bytes]:
    """The header of a capture, then its packets: from straight ahead on, with a packet of another
    kind after each fifth."""
    data = [struct.pack(f"{order}IHHiIII", magic, 2, 4, 0, 0, 65_535, 1)]
    unit_ns = 1000 if magic == 0xA1B2C3D4 else 1
    for i in range(int(num_turns * PACKETS_PER_TURN)):
        since_us = i * PACKET_US
        payload = vlp16_payload(round(i * 36_000 / PACKETS_PER_TURN) % 36_000, since_us)
        for packet in (payload, bytes(512))[: 2 if i % 5 == 0 else 1]:
            size, fraction = len(HEADERS + packet), since_us * 1000 // unit_ns
            head = struct.pack(f"{order}IIII", START_S, fraction, size, size)
            data.append(head + HEADERS + packet)
    return data


def capture(*options) -> bytes:
    return b"".join(records(*options))


@pytest.fixture
def vlp16(tmp_path):
    path = tmp_path / "drive.pcap"
    path.write_bytes(capture(2.75))
    return path


@pytest.mark.parametrize(
    ("order", "magic"), [("<", 0xA1B2C3D4), (">", 0xA1B2C3D4), ("<", 0xA1B23C4D)]
)
def test_turns_begin_straight_behind(tmp_path, order, magic):
    pytest.importorskip("velodyne_decoder")
    path = tmp_path / "drive.pcap"
    path.write_bytes(capture(2.75, order, magic))
    sequence = open_sequence(f"velodyne:{path}#VLP-16")
    assert isinstance(sequence, Velodyne) and list(sequence.frames) == [0, 1]
    period_ns = PACKETS_PER_TURN * PACKET_US * 1000
    assert sequence.stamp_ns(1) - sequence.stamp_ns(0) == period_ns
    last = PACKETS_PER_TURN + PACKETS_PER_TURN // 2 - 1  # of the turn from behind to behind
    assert sequence.stamp_ns(0) == START_S * 10**9 + last * PACKET_US * 1000
    sweep = sequence[0]
    assert len(sweep) == PACKETS_PER_TURN * 12 * 32
    np.testing.assert_allclose(np.linalg.norm(sweep.points, axis=1), RANGE_M, atol=0.01)
    np.testing.assert_allclose(sweep.intensity, 100 / 255, atol=1e-6)
    x, y, z = sweep.points.T
    elevation_deg = np.degrees(np.arctan2(z, np.hypot(x, y)))
    rings = np.unique(np.rint(elevation_deg))
    np.testing.assert_array_equal(rings, np.arange(-15, 16, 2))
    assert np.ptp(sweep.offset_ns) == pytest.approx(period_ns, rel=0.01)
    # it turns clockwise and faces forward in the middle
    azimuth = np.arctan2(y, x)
    share = (sweep.offset_ns - sweep.offset_ns.min()) / period_ns
    off = (azimuth - (np.pi - 2 * np.pi * share) + np.pi) % (2 * np.pi) - np.pi
    assert np.abs(np.degrees(off)).max() < 1


def test_lost_and_doubled_packets_are_told_and_doubled_ones_read_once(tmp_path):
    pytest.importorskip("velodyne_decoder")
    whole, path = records(2.75), tmp_path / "drive.pcap"
    path.write_bytes(b"".join(whole))
    complete = open_sequence(f"velodyne:{path}#VLP-16")
    num_complete = len(complete[0])
    returns = [i for i, packet in enumerate(whole) if len(packet) == max(map(len, whole))]
    lost, twice = returns[60:63], returns[80]  # of the first whole turn
    kept = [i for i in range(len(whole)) if i not in lost]
    path.write_bytes(b"".join(whole[i] for i in sorted([*kept, twice])))
    sequence = open_sequence(f"velodyne:{path}#VLP-16")
    (_, told), num = sequence.findings()[0], len(returns) - 3
    assert told.startswith(f"{num}, 3 lost (1.4 %)") and "1 captured twice" in told
    assert len(sequence[0]) == num_complete - 3 * 12 * 32
    assert "0 lost (0.0 %), 0 captured" in complete.findings()[0][1]
    cut_off = b"".join(whole)
    path.write_bytes(cut_off[: len(cut_off) // 2])  # in the middle of a packet
    assert list(Velodyne(path, "VLP-16").frames) == [0]


def test_the_model_or_the_metadata_has_to_be_named(vlp16):
    for spec, got in ((vlp16, "no model and no metadata"), (f"velodyne:{vlp16}#HDL-64", "HDL-64")):
        with pytest.raises(InputError, match=f"got .*{got}; name the Velodyne") as error:
            open_sequence(spec)
        assert all(model in str(error.value) for model in MODELS)
    (vlp16.parent / "other.json").write_text("{}")
    with pytest.raises(InputError, match=r"an Ouster's metadata .json .*there: other\.json"):
        open_sequence(f"ouster:{vlp16}#third.json")


NO_CAPTURES = {
    "not a capture of packets": b"",
    "editcap": b"\x0a\x0d\x0d\x0a" + bytes(60),
    "no Velodyne packets": capture(0) + struct.pack("<IIII", 0, 0, 600, 600) + bytes(600),
}


@pytest.mark.parametrize("says", NO_CAPTURES)
def test_what_is_no_capture_is_refused_in_a_line(tmp_path, says):
    pytest.importorskip("velodyne_decoder")
    (tmp_path / "drive.pcap").write_bytes(NO_CAPTURES[says])
    check_refused(f"velodyne:{tmp_path / 'drive.pcap'}#VLP-16", says, tmp_path)


@pytest.mark.parametrize(
    ("package", "reader", "scene"),
    [("velodyne_decoder", "velodyne", "VLP-16"), ("ouster.sdk.core", "ouster", "drive.json")],
)
def test_without_the_package_the_remedy_is_named(vlp16, monkeypatch, package, reader, scene):
    monkeypatch.setitem(sys.modules, package, None)
    (vlp16.parent / "drive.json").write_text("{}")
    with pytest.raises(InputError, match=rf"pip install '\.\[{reader}\]'"):
        open_sequence(f"{reader}:{vlp16}#{scene}")


def test_an_ousters_metadata_is_found_beside_it(vlp16):
    metadata = vlp16.with_suffix(".json")
    metadata.write_text("{}")
    metadata.with_name("other.json").write_text("{}")
    pytest.importorskip("ouster.sdk.core")
    check_refused(vlp16, r"drive\.pcap: cannot be decoded with drive\.json")
    metadata.write_text("{")
    check_refused(vlp16, r"drive\.json: not a whole JSON file")
    metadata.rename(metadata.with_name("third.json"))
    check_refused(vlp16, r"there: other\.json, third\.json")


# Real captures


def test_a_real_velodyne(test_data):
    pytest.importorskip("velodyne_decoder")
    path = test_data / "velodyne_pcap/hdl32e_driving.pcap"
    sequence = open_sequence(f"velodyne:{path}#HDL-32E")
    assert list(sequence.frames) == list(range(17))
    periods_s = np.diff([sequence.stamp_ns(n) for n in sequence.frames]) * 1e-9
    np.testing.assert_allclose(periods_s, 1 / 11.75, rtol=0.01)
    sweep = sequence[5]
    x, y, z = sweep.points.T
    # as the maker states: 32 rings from -30.67 to 10.67 degrees, from 2.9 cm ahead of the axis
    elevation = np.arctan2(z, np.hypot(x, y) - 0.029).astype(np.float32)
    rings_deg = np.degrees(find_rings(elevation))
    np.testing.assert_allclose(rings_deg, np.linspace(-30.67, 10.67, 32), atol=0.02)
    # the first block of the sweep by hand: ranges in 2 mm, laser by laser
    begin = int(sequence._begin[sequence._turns[5].start])
    block = path.read_bytes()[begin : begin + 100]
    ranges_m = np.frombuffer(block[4:], [("r", "<u2"), ("i", "u1")], 32)["r"] * 0.002
    heard = ranges_m[(ranges_m > 0.1) & (ranges_m < 200)]
    first = sweep.points[: len(heard)]
    np.testing.assert_allclose(np.linalg.norm(first, axis=1), heard, atol=0.03)
    azimuth_deg = int.from_bytes(block[2:4], "little") / 100
    assert 180 <= azimuth_deg < 183
    turned_deg = -np.degrees(np.arctan2(first[0, 1], first[0, 0])) % 360
    assert turned_deg == pytest.approx(azimuth_deg, abs=0.3)


def test_a_real_ouster(test_data):
    pytest.importorskip("ouster.sdk.core")
    path = test_data / "ouster/OS-1-128_v2.3.0_1024x10_lb_n3.pcap"
    sequence = open_sequence(path)
    assert isinstance(sequence, Ouster) and list(sequence.frames) == [0, 1, 2]
    seconds, microseconds = struct.unpack_from("<II", path.read_bytes(), 24)
    assert sequence.stamp_ns(0) == seconds * 10**9 + microseconds * 1000
    sweep = sequence[0]
    assert len(sweep) == 107_647 and sweep.row.max() < 128 * 1024
    # as the sensor's clock has the first and the last column
    assert (sweep.offset_ns.min(), sweep.offset_ns.max()) == (0, 991_687_215_910 - 991_587_364_520)
    np.testing.assert_allclose(sweep.scanner_origins, [[0, 0, 0.03618]])
    at = np.flatnonzero(sweep.row == 64 * 1024 + 512)[0]
    range_m = np.linalg.norm(sweep.points[at] - sweep.scanner_origins[0])
    assert range_m == pytest.approx(35.504, abs=0.02)  # 35504 mm in the packet
    assert 0 < sweep.intensity.max() <= 1
    x, y, _ = sweep.points.T
    column = sweep.row % 1024
    off = np.degrees(np.arctan2(y, x)) + 360 * column / 1024
    spread = np.abs((off - np.median(off % 360) + 180) % 360 - 180)
    assert np.median(spread) < 8  # it turns clockwise; lasers sit up to 4 degrees aside
    assert sequence.findings() == [
        ("packets", "192, 0 lost (0.0 %), 0 captured twice and read once")
    ]


def test_packets_of_an_ouster_are_counted_over_turns() -> None:
    """Its count of turns wraps, packets may come late, and it may send some columns only."""
    turn, column = (a.ravel() for a in np.mgrid[65_534:65_538, 256:768:16])
    late = np.arange(len(turn))
    late[[31, 32]] = 32, 31
    assert count_lost_and_repeated(turn[late] % 65_536, column[late]) == (0, 0)
    kept = np.setdiff1d(np.arange(len(turn)), [5, 40, 41])
    again = np.concatenate([kept[:50], kept[49:]])
    assert count_lost_and_repeated(turn[again] % 65_536, column[again]) == (3, 1)
