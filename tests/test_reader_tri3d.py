# SPDX-License-Identifier: MIT
"""The reader through tri3d: the street as a sequence of ONCE, a small one of ZOD, broken ones."""

from __future__ import annotations

import json
import pickle
import shutil
import sys
from datetime import datetime, timedelta, timezone
from importlib.util import find_spec

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from writers.excerpt import Excerpt

from densify.config.errors import InputError
from densify.geometry.cameras import image_points
from densify.geometry.poses import inverse
from densify.outputs.depth_png import encode_png
from densify.readers import open_sequence
from densify.readers.street import Street
from densify.readers.tri3d import Tri3d
from tests.reader_checks import check_refused

# Importing it compiles for three seconds: nothing for processes that run other tests.
pytestmark = pytest.mark.skipif(find_spec("tri3d") is None, reason="tri3d needs Python 3.11")

FRAMES, CAMERA, NAME = (59, 60, 61), "image_02", "000076"
T_ONCE_LIDAR = np.eye(4)  # x left, y back
T_ONCE_LIDAR[:3, :3] = [[0, 1, 0], [-1, 0, 0], [0, 0, 1]]
MS = 1_000_000


@pytest.fixture(scope="module")
def excerpt():
    return Excerpt.of(Street("street", 0, "vlp16", cameras=(CAMERA,)), FRAMES, None)


def quaternion_last(T):
    """x y z w and the place, as ONCE has poses."""
    return [*Rotation.from_matrix(T[:3, :3]).as_quat(), *T[:3, 3]]


@pytest.fixture(scope="module")
def once(excerpt, tmp_path_factory):
    """ONCE as its documentation has it: one JSON file for a sequence, files named by milliseconds.
    Its sweeps are the street's at one moment."""
    root, street = tmp_path_factory.mktemp("once"), excerpt.street
    folder = root / "data" / NAME
    for name in ("lidar_roof", "cam01"):
        (folder / name).mkdir(parents=True)
    camera, frames = street.cameras[CAMERA], []
    images = excerpt.image_numbers(CAMERA)
    for frame, image in zip(FRAMES, images, strict=True):
        stamp = str(round(street.stamp_ns(frame) / MS))
        points = street.truth.sweep(frame).points @ T_ONCE_LIDAR[:3, :3].T
        rows = np.column_stack([points, street[frame].intensity]).astype(np.float32)
        rows.tofile(folder / "lidar_roof" / f"{stamp}.bin")
        bgr = np.ascontiguousarray(street.image(CAMERA, image)[:, :, ::-1])
        (folder / "cam01" / f"{stamp}.jpg").write_bytes(encode_png(bgr))
        T_world_once = street.T_world_lidar(frame) @ inverse(T_ONCE_LIDAR)
        frames.append({"frame_id": stamp, "pose": quaternion_last(T_world_once)})
    frames[0]["annos"] = {"names": ["Car"], "boxes_3d": [[5.0, 2, -1, 4, 2, 1.5, 0.1]]}
    calibration = {
        "cam_to_velo": (T_ONCE_LIDAR @ inverse(camera.T_cam_lidar)).tolist(),
        "cam_intrinsic": camera.K.tolist(),
        "distortion": [0.0] * 5,
    }
    content = {"meta_info": {}, "calib": {"cam01": calibration}, "frames": frames}
    (folder / f"{NAME}.json").write_text(json.dumps(content))
    return root


@pytest.fixture
def broken(once, tmp_path):
    """A copy to be damaged."""
    return shutil.copytree(once, tmp_path / "once")


def test_once_is_given_back(once, excerpt):
    sequence, street = open_sequence(once), excerpt.street
    assert isinstance(sequence, Tri3d) and sequence.name == NAME
    assert list(sequence.frames) == [0, 1, 2]
    camera, true_camera = sequence.cameras["cam01"], street.cameras[CAMERA]
    assert list(sequence.cameras) == ["cam01"]
    assert (camera.width_px, camera.height_px) == (true_camera.width_px, true_camera.height_px)
    assert camera.is_rectified
    np.testing.assert_allclose(camera.K, true_camera.K)
    np.testing.assert_allclose(camera.T_cam_lidar, true_camera.T_cam_lidar, atol=1e-9)
    for number, frame in enumerate(FRAMES):
        sweep, stamp_ns = sequence[number], round(street.stamp_ns(frame) / MS) * MS
        assert sweep.stamp_ns == sequence.image_stamps_ns("cam01")[number] == stamp_ns
        assert sweep.offset_ns is None and sweep.scanner_origins is None
        np.testing.assert_allclose(sweep.points, street.truth.sweep(frame).points, atol=1e-5)
        np.testing.assert_array_equal(sweep.intensity, street[frame].intensity)
        T_world_lidar = street.T_world_lidar(frame)
        np.testing.assert_allclose(sequence.T_world_lidar(number), T_world_lidar, atol=1e-9)
        image = excerpt.image_numbers(CAMERA)[number]
        np.testing.assert_array_equal(sequence.image("cam01", number), street.image(CAMERA, image))


def test_scenes(once, tmp_path):
    assert open_sequence(f"tri3d:{once}#Once/{NAME}").name == NAME
    split = tmp_path / "once" / "train"
    shutil.copytree(once, split)
    assert open_sequence(f"tri3d:{split.parent}#Once/{NAME}").name == NAME
    with pytest.raises(InputError, match=f"no recording Waymo/1; .* one of Once/{NAME}"):
        open_sequence(f"tri3d:{once}#Waymo/1")
    with pytest.raises(InputError, match="nothing that tri3d is asked for"):
        open_sequence(f"tri3d:{once / 'data'}")


def test_the_library_is_named_where_it_is_missing(once, monkeypatch):
    monkeypatch.setitem(sys.modules, "tri3d", None)
    with pytest.raises(InputError, match=r"pip install 'densify\[tri3d\]'"):
        open_sequence(once)


# ZOD

START = datetime(2022, 2, 14, 13, 23, 33, 29609, timezone.utc)
LENS = [0.1, -0.02, 0.003, -0.0004]
POINT = [[8.0, -1.0, -0.5], [20.0, 3.0, 1.0]]  # x forward, y left


def turned(yaw_deg, place_m):
    T = np.eye(4)
    T[:3, :3] = Rotation.from_euler("z", yaw_deg, degrees=True).as_matrix()
    T[:3, 3] = place_m
    return T


T_EGO_ZOD = turned(90, [1.0, 0.2, 2.0])  # of the lidar as stored: x right, y forward
T_EGO_CAM = np.array([[0, 0, 1, 1.5], [-1, 0, 0, 0], [0, -1, 0, 1.4], [0, 0, 0, 1.0]])


@pytest.fixture
def zod(tmp_path):
    """Three sweeps 0.1 s apart, one image, and a vehicle that turns past half a turn."""
    root, folder = tmp_path / "zod", tmp_path / "zod/single_frames/000001"
    folder.mkdir(parents=True)
    times = [START + timedelta(seconds=0.1 * i) for i in range(3)]
    fields = [(name, np.float32) for name in "xyz"]
    fields += [("timestamp", np.int64), ("intensity", np.uint8), ("diode_index", np.uint8)]
    rows = np.zeros(2, fields)
    rows["x"], rows["y"], rows["z"] = [1.0, -3.0], [8.0, 20.0], [-0.5, 1.0]
    sweeps = []
    for i, time in enumerate(times):
        np.save(folder / f"{i}.npy", rows)
        sweeps.append({"filepath": f"single_frames/000001/{i}.npy", "time": time.isoformat()})
    image = np.arange(8 * 12 * 3, dtype=np.uint8).reshape(8, 12, 3)
    (folder / "front.jpg").write_bytes(encode_png(image))
    images = [{"filepath": "single_frames/000001/front.jpg", "time": times[1].isoformat()}]
    sequence = {
        "id": "000001",
        "keyframe_time": times[1].isoformat(),
        "camera_frames": {"front_blur": images},
        "lidar_frames": {"velodyne": sweeps},
    }
    listed = json.dumps({"train": [], "val": [sequence]})
    (root / "trainval-frames-mini.json").write_text(listed)
    (folder / "calibration.json").write_text(
        json.dumps(
            {
                "FC": {
                    "intrinsics": [[900.0, 0, 6.0], [0, 910.0, 4.0], [0, 0, 1]],
                    "distortion": LENS,
                    "extrinsics": T_EGO_CAM.tolist(),
                    "lidar_extrinsics": T_EGO_ZOD.tolist(),
                }
            }
        )
    )
    at_s = [-0.01 + 0.04 * i for i in range(7)]
    motion = {
        "timestamps": [START.timestamp() + s for s in at_s],
        "poses": [turned(175 + 50 * s, [10 * s, 0, 0]).tolist() for s in at_s],
    }
    (folder / "ego_motion.json").write_text(json.dumps(motion))
    return root


def test_zod_is_given_back(zod):
    sequence = open_sequence(f"tri3d:{zod}#ZODFrames/000001")
    assert list(sequence.frames) == [0, 1, 2]
    start_ns = 1_644_845_013_029_609_000
    assert [sequence.stamp_ns(i) - start_ns for i in range(3)] == [0, 100 * MS, 200 * MS]
    assert sequence.image_stamps_ns("front") == {0: start_ns + 100 * MS}
    sweep = sequence[1]
    np.testing.assert_allclose(sweep.points, POINT)
    assert sweep.offset_ns is None and not sweep.intensity.any()
    assert "cannot be undone" in dict(sequence.findings())["compensated"]
    T_ego_lidar = turned(180, [1.0, 0.2, 2.0])
    for i in range(3):
        T = turned(175 + 5 * i, [i, 0, 0]) @ T_ego_lidar
        np.testing.assert_allclose(sequence.T_world_lidar(i), T, atol=1e-6)
    camera = sequence.cameras["front"]
    assert (camera.width_px, camera.height_px, camera.model) == (12, 8, "fisheye")
    assert camera.distortion == tuple(LENS)
    np.testing.assert_allclose(camera.T_cam_lidar, inverse(T_EGO_CAM) @ T_ego_lidar, atol=1e-9)
    assert sequence.image("front", 0).shape == (8, 12, 3)


def test_lenses_are_those_of_the_library(zod, broken):
    import tri3d

    path = broken / "data" / NAME / f"{NAME}.json"
    edit(lambda c: c["calib"]["cam01"].update(distortion=[-0.3, 0.1, 1e-3, -2e-3, 0.02]))(path)
    once = tri3d.datasets.Once(broken, ".")
    frames = tri3d.datasets.ZODFrames(zod, split="val", anon_method="blur")
    points = np.array([[0.3, -0.2, 4.0], [-1.0, 0.5, 6.0], [2.0, 1.0, 9.0]])
    for data, names, sequence in (
        (once, ("cam01", "img01"), open_sequence(broken)),
        (frames, ("front", "img_front"), open_sequence(zod)),
    ):
        camera = sequence.cameras[names[0]]
        uv, _ = image_points(camera, points)
        np.testing.assert_allclose(uv, data.alignment(0, 0, names).apply(points)[:, :2], atol=1e-6)


class Trap:
    """Raises what is not an error of input if a pickle of it is run."""

    def __reduce__(self):
        return (pytest.fail, ("a pickle was run",))


@pytest.mark.parametrize(
    "harm",
    [
        lambda path: path.write_bytes(pickle.dumps(Trap())),
        lambda path: np.save(path, np.array([Trap()], object), allow_pickle=True),
        lambda path: np.save(path, np.zeros((4, 3))),
        lambda path: path.write_bytes(b"PK\x03\x04"),
        lambda path: path.unlink(),
    ],
)
def test_no_pickle_is_run(zod, harm):
    harm(zod / "single_frames/000001/1.npy")
    sequence = open_sequence(zod)
    with pytest.raises(InputError, match="sweep 1: tri3d cannot read it") as error:
        sequence[1]
    assert "\n" not in str(error.value) and len(sequence[0])


# Damage


def edit(change):
    def harm(path):
        content = json.loads(path.read_text())
        change(content)
        path.write_text(json.dumps(content))

    return harm


JSON, SWEEP = f"data/{NAME}/{NAME}.json", "data/*/lidar_roof/*.bin"
LIST, TRACK = "trainval-frames-mini.json", "single_frames/000001/ego_motion.json"
DAMAGE = {
    "JSON cut": (JSON, lambda p: p.write_bytes(p.read_bytes()[:-9]), "JSONDecodeError"),
    "sweep cut": (SWEEP, lambda p: p.write_bytes(p.read_bytes()[:-3]), "sweep 0: tri3d cannot"),
    "no track": (TRACK, lambda p: p.unlink(), "FileNotFoundError"),
}


@pytest.mark.parametrize("damage", DAMAGE)
def test_damage_is_refused_in_a_line(broken, zod, damage):
    pattern, harm, says = DAMAGE[damage]
    root = zod if pattern in (LIST, TRACK) else broken
    harm(min(root.glob(pattern)))
    check_refused(f"tri3d:{root}", says, root)
