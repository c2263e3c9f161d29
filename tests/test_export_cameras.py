# SPDX-License-Identifier: MIT
"""Exports with cameras: COLMAP's own reader, nerfstudio's format, splats, and where points land."""

from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np
import pytest
import yaml
from plyfile import PlyData
from scipy.ndimage import map_coordinates

from densify.geometry import poses
from densify.geometry.cameras import image_points
from densify.geometry.types import ObjectTrack, Result
from densify.outputs.cloud_files import read_cloud
from densify.outputs.depth_png import read_depth_png
from densify.outputs.finished_run import export_run
from tests.exported import STAMPS_NS, H, W, refused, write_drive, write_views
from tests.small_street import KEY, one_car

TWO = {"image_02": "plain", "image_03": "bent"}


@pytest.fixture
def put(tmp_path):
    return lambda lenses=TWO, **options: write_views(tmp_path, lenses, **options)


@pytest.fixture(scope="module")
def drive(tmp_path_factory) -> Path:
    return write_drive(tmp_path_factory.mktemp("drive"))


@pytest.fixture(scope="module")
def street(drive) -> Path:
    return drive / f"{KEY:06d}"


def colmap(run: Path, to: str = "colmap", **arguments):
    """The model, by COLMAP's own reader."""
    pycolmap = pytest.importorskip("pycolmap")
    export_run(run, to, **arguments)
    return pycolmap.Reconstruction(str(run / "export" / to / "sparse" / "0"))


def places_of(model) -> np.ndarray:
    return np.array([model.points3D[i].xyz for i in sorted(model.points3D)])


# --- COLMAP ---------------------------------------------------------------------------------------


@pytest.mark.parametrize("lens", ["plain", "bent", "bent5", "bent8", "fisheye"])
def test_a_model_by_colmaps_own_reader(put, lens: str) -> None:
    run, result = put({"fast/000359": lens, "fast/000360": lens, "image_03": "plain"})
    model = colmap(run)
    assert len(model.cameras) == 2
    names = sorted(image.name for image in model.images.values())
    assert names == ["fast/000359.jpg", "fast/000360.jpg", "image_03.jpg"]
    for image in model.images.values():
        view = result.views[image.name.removesuffix(".jpg")]
        T_cam_world = image.cam_from_world().matrix()
        np.testing.assert_allclose(T_cam_world, view.T_cam_key[:3], atol=1e-12)
        camera = model.cameras[image.camera_id]
        assert (camera.width, camera.height) == (W, H)
        rng = np.random.default_rng(0)
        points_cam = rng.uniform([-0.4, -0.3, 1], [0.4, 0.3, 1], (50, 3)) * 7
        uv, _ = image_points(view.camera, points_cam)
        np.testing.assert_allclose(camera.img_from_cam(points_cam), uv + 0.5, atol=1e-6)
    cloud = read_cloud(run / "cloud.laz")
    observed = cloud.rgb.any(axis=1)
    assert 0 < observed.sum() < len(observed)
    colours = np.array([model.points3D[i].color for i in sorted(model.points3D)])
    np.testing.assert_allclose(places_of(model), cloud.points[observed], atol=1e-9)
    np.testing.assert_array_equal(colours, cloud.rgb[observed])


def test_points_land_on_their_depth_by_colmaps_own_camera(street: Path) -> None:
    """Pixel centres, axes and poses at once: what COLMAP projects is where our maps have it."""
    model = colmap(street)
    (image,) = model.images.values()
    points_cam = image.cam_from_world() * places_of(model)
    uv = model.cameras[image.camera_id].img_from_cam(points_cam)
    check_depth(street, uv, points_cam[:, 2])


def check_depth(run: Path, uv: np.ndarray, z_m: np.ndarray) -> None:
    """Points lie on the map's surface, better than a third of a pixel beside: pixel (0, 0) has its
    centre at (0.5, 0.5)."""
    depth_m = read_depth_png(run / "depth_filled" / "front.png")

    def off_m(aside_px):
        at = (uv - 0.5 + aside_px).T[::-1]
        near = np.abs(map_coordinates(depth_m, np.rint(at), order=0) - z_m) < 0.5
        return np.median(np.abs(map_coordinates(depth_m, at[:, near], order=1) - z_m[near]))

    exact_m = off_m([0, 0])
    assert exact_m < 0.01
    for aside_px in ([0.33, 0], [-0.33, 0], [0, 0.33], [0, -0.33]):
        assert off_m(aside_px) > 1.2 * exact_m, (exact_m, aside_px, off_m(aside_px))


# --- nerfstudio -----------------------------------------------------------------------------------


@pytest.mark.parametrize("to", ["nerfstudio", "wai"])
def test_frames_by_the_formats_of_nerfstudio_and_map_anything(put, to: str) -> None:
    """As nerfstudio's get_depth_image_from_path reads depth with its usual scale, and as
    data_processing/README.md of map-anything describes scene_meta.json."""
    exr = pytest.importorskip("OpenEXR")
    run, result = put({"image_02": "plain", "image_03": "plain" if to == "wai" else "bent"})
    export_run(run, to)
    folder = run / "export" / to
    (path,) = folder.glob("*.json")
    table = json.loads(path.read_text())
    assert table["camera_model"] == ("PINHOLE" if to == "wai" else "OPENCV")
    axes = np.eye(4) if to == "wai" else np.diag([1, -1, -1, 1])  # OpenGL: x right, y up, z back
    for frame, (name, view) in zip(table["frames"], result.views.items(), strict=True):
        assert cv2.imread(str(folder / frame["file_path"])).shape == (frame["h"], frame["w"], 3)
        assert [frame[k] for k in ("fl_x", "fl_y", "cx", "cy")] == [17.25, 18.5, 9.625, 6.25]
        T_cam_world = axes @ np.linalg.inv(frame["transform_matrix"])
        np.testing.assert_allclose(T_cam_world, view.T_cam_key, atol=1e-12)
        if to == "wai":
            channels = exr.File(str(folder / frame["depth"])).channels()
            (depth_m,) = (channel.pixels for channel in channels.values())
        else:
            depth_m = np.load(folder / frame["depth_file_path"]) * 1e-3
            lens = [*view.camera.distortion, 0, 0, 0, 0][:4]
            assert [frame[k] for k in ("k1", "k2", "p1", "p2")] == lens and frame["k3"] == 0
        np.testing.assert_allclose(depth_m, read_depth_png(run / "depth" / f"{name}.png"), 1e-7)
    if to == "wai":
        assert table["camera_convention"] == "opencv"
        assert table["frame_modalities"]["depth"] == {"frame_key": "depth", "format": "depth"}
        return
    vertex = PlyData.read(folder / table["ply_file_path"])["vertex"].data
    assert vertex.dtype.names == ("x", "y", "z", "red", "green", "blue")
    assert len(vertex) == read_cloud(run / "cloud.laz").observed.sum()


def test_points_land_on_their_depth_by_opengls_camera(street: Path) -> None:
    export_run(street, "nerfstudio")
    table = json.loads((street / "export" / "nerfstudio" / "transforms.json").read_text())
    (frame,) = table["frames"]
    vertex = PlyData.read(street / "export" / "nerfstudio" / "cloud.ply")["vertex"].data
    points = np.stack([vertex[a] for a in "xyz"] + [np.ones(len(vertex))], axis=1)
    x, y, back, _ = (points.astype(float) @ np.linalg.inv(frame["transform_matrix"]).T).T
    u = frame["cx"] - frame["fl_x"] * x / back
    v = frame["cy"] + frame["fl_y"] * y / back
    check_depth(street, np.stack([u, v], axis=1), -back)


# --- splats ---------------------------------------------------------------------------------------


def track_of(instance: int, heading: float = 0.3) -> ObjectTrack:
    T = poses.exp(np.array([0, 0, heading, 12.0, 1.0, -0.8]))
    return ObjectTrack(
        instance=instance,
        size_m=np.array([4.0, 1.75, 1.5]),
        frames=(120, 121),
        stamp_ns=np.array([STAMPS_NS[120], STAMPS_NS[121] + 1]),
        T_key_object=np.stack([T, T @ poses.exp(np.array([0, 0, 0, 0.5, 0.25, 0]))]),
        velocity_m_s=np.array([[5.0, 2.5, 0.0]] * 2),
        num_points=np.array([33, 20]),
        seen_size_m=np.array([2.5, 1.75, 1.25]),
        sides_seen=("rear", "left", "right", "top"),
    )


@pytest.fixture
def tracked(put) -> tuple[Path, Result]:
    return put(tracks=(track_of(3), track_of(5, heading=2.0)))


def test_splats_keep_objects_apart_in_their_own_frames(tracked) -> None:
    run, result = tracked
    model = colmap(run, "splats")
    folder, cloud = run / "export" / "splats", read_cloud(run / "cloud.laz")
    static = PlyData.read(folder / "sparse" / "0" / "points3D.ply")["vertex"].data
    assert static.dtype.names == ("x", "y", "z", "nx", "ny", "nz", "red", "green", "blue")
    assert len(static) == (~cloud.moving & cloud.rgb.any(axis=1)).sum() == len(model.points3D)
    np.testing.assert_allclose(places_of(model)[:, 0], static["x"], atol=1e-5)
    of_tracks = np.zeros(len(cloud.points), bool)
    for track in result.tracks:
        own = PlyData.read(folder / "movers" / f"{track.instance:04d}.ply")["vertex"].data
        in_object = np.stack([own[a] for a in "xyz"], axis=1).astype(float)
        mine = cloud.instance == track.instance
        points = poses.transform(track.T_key_object[0], in_object)
        np.testing.assert_allclose(points, cloud.points[mine], atol=1e-4)
        np.testing.assert_array_equal(own["green"], cloud.rgb[mine, 1])
        of_tracks |= mine
    others = PlyData.read(folder / "movers" / "others.ply")["vertex"].data
    rest = cloud.moving & ~of_tracks
    np.testing.assert_array_equal(others["x"], cloud.points[rest, 0].astype(np.float32))
    assert (folder / "tracks.json").read_bytes() == (run / "movers.json").read_bytes()
    # The cloud is read for the static world and for the objects, and counted once.
    record = yaml.safe_load((folder / "export.yaml").read_text("utf-8"))
    assert record["num_points"]["before"] == len(cloud.points)


def test_depths_by_the_reader_of_gaussian_splatting(put) -> None:
    """As its loadCam and Camera read ``--depths depths``: inverse depth is value / 2^16 * scale +
    offset unless the scale is far from the median; where it is 0, the image is transparent."""
    run, _ = put({"image_02/0000000241": "plain", "image_03": "plain"})
    colmap(run, "splats")
    folder = run / "export" / "splats"
    params = json.loads((folder / "sparse" / "0" / "depth_params.json").read_text())
    median = np.median([value["scale"] for value in params.values()])
    assert set(params) == {"image_02_0000000241", "image_03"}
    for name, value in params.items():
        assert 0.2 * median <= value["scale"] <= 5 * median
        stored = cv2.imread(str(folder / "depths" / f"{name}.png"), -1)
        assert stored.dtype == np.uint16
        inverse = stored.astype(np.float32) / float(2**16) * value["scale"] + value["offset"]
        map_name = name.replace("image_02_", "image_02/")
        filled_m = read_depth_png(run / "depth_filled" / f"{map_name}.png")
        known = filled_m > 0
        assert (stored[~known] == 0).all() and not known.all()
        np.testing.assert_allclose(1 / inverse[known], filled_m[known], rtol=0.02)
        near = known & (filled_m < 30)
        np.testing.assert_allclose(1 / inverse[near], filled_m[near], rtol=2e-3)
        image = cv2.imread(str(folder / "images" / f"{name}.png"), -1)
        np.testing.assert_array_equal(image[..., 3] == 255, known)
        assert not image[~known].any()


# --- training sets --------------------------------------------------------------------------------


def test_a_set_by_the_reader_of_moge(put) -> None:
    """As read_depth of its moge/utils/io.py: 16 bit, logarithmic from near to far, 0 unknown."""
    image = pytest.importorskip("PIL.Image")
    run, result = put({"image_02": "plain", "image_03": "plain"})
    export_run(run, "moge")
    folder = run / "export" / "moge"
    instances = (folder / ".index.txt").read_text().splitlines()
    for place, (name, view) in zip(instances, result.views.items(), strict=True):
        stored = image.open(folder / place / "depth.png")
        near, far = float(stored.info["near"]), float(stored.info["far"])
        share = (np.array(stored).astype(np.float32) - 1) / 65533
        depth_m = np.where(np.array(stored) == 0, 0, near ** (1 - share) * far**share)
        true_m = read_depth_png(run / "depth" / f"{name}.png")
        np.testing.assert_allclose(depth_m, true_m, rtol=1e-4)
        K = np.array(json.loads((folder / place / "meta.json").read_text())["intrinsics"])
        pixel = view.camera.K @ [0.1, 0.2, 1]
        u, v, _ = K @ [0.1, 0.2, 1]  # of 0 to 1 over the image, whose first pixel is 1 / W wide
        np.testing.assert_allclose([u * W - 0.5, v * H - 0.5], pixel[:2])
        assert (folder / place / "image.jpg").is_file()


def test_several_keys_share_one_world(drive: Path, tmp_path: Path) -> None:
    export_run(drive, "nerfstudio", tmp_path / "n")
    export_run(drive, "splats", tmp_path / "s")
    assert len([*(tmp_path / "s" / "depths").iterdir()]) == 2
    assert (tmp_path / "s" / "movers" / f"{KEY:06d}" / "tracks.json").is_file()
    frames = json.loads((tmp_path / "n" / "transforms.json").read_text())["frames"]
    T_world_cam = [frame["transform_matrix"] @ np.diag([1, -1, -1, 1]) for frame in frames]
    truth = [one_car().T_world_lidar(key) for key in (KEY, KEY + 1)]
    T_lidar_cam = np.linalg.inv(one_car().cameras["front"].T_cam_lidar)
    moved = np.linalg.inv(truth[0] @ T_lidar_cam) @ truth[1] @ T_lidar_cam
    np.testing.assert_allclose(np.linalg.inv(T_world_cam[0]) @ T_world_cam[1], moved, atol=0.02)


# --- what a format lacks, and damaged runs --------------------------------------------------------

BENT = "image_02: --to wai takes images without distortion"
RANGE = "image_02: its depth is the range"


@pytest.mark.parametrize(
    ("to", "lenses", "measure", "words"),
    [
        ("colmap", {"image_02": "plain", "image_03": "prism"}, "z", "image_03: its lens"),
        ("colmap", {"image_02": "plain", "image_03": "mei"}, "z", "image_03: its lens (mei"),
        ("nerfstudio", {"image_02": "plain", "image_03": "fisheye"}, "z", "one camera model"),
        ("nerfstudio", {"image_02": "bent8"}, "z", "no lens with k4, k5, k6"),
        ("wai", {"image_02": "bent"}, "z", BENT),
        ("moge", {"image_02": "bent"}, "z", BENT.replace("wai", "moge")),
        *((to, {"image_02": "plain"}, "range", RANGE) for to in ("wai", "moge", "splats")),
        ("nerfstudio", {"image_02": "fisheye"}, "range", RANGE),
    ],
)
def test_what_a_format_lacks(put, to: str, lenses: dict, measure: str, words: str) -> None:
    pytest.importorskip("OpenEXR")
    run, _ = put(lenses, measure=measure)
    refused(words, "--camera" if measure == "z" else "project.depth=z", run=run, to=to)
    if "image_03" in lenses:
        export_run(run, to, cameras=["image_02"])


def test_runs_without_images_or_scene(put) -> None:
    run, _ = put()
    image = run / "scene" / "image" / "image_02.jpg"
    image.write_bytes(image.read_bytes()[:-40])
    refused(image, "not a complete image", run=run, to="colmap")
    cv2.imwrite(str(image), np.zeros((H, W + 1, 3), np.uint8))
    refused(f"got {W + 1} x {H} px, expected {W} x {H}", run=run, to="colmap")
    for path in (run / "scene" / "image").iterdir():
        path.unlink()
    refused("no images in scene/image of image_02, image_03", run=run, to="nerfstudio")
    (run / "scene" / "scene.json").unlink()
    refused("scene.json: cannot be read", run=run, to="nerfstudio")


def test_damaged_tables_are_named(tracked) -> None:
    run, _ = tracked
    for file, damages in (
        ("scene/scene.json", (('"pinhole"', '"cone"'), ('"width_px": 20', '"width_px": 0'))),
        ("movers.json", (('"frame": 120', '"frame": 7'), ('"poses": [', '"poses": [], "p": ['))),
    ):
        path = run / file
        whole = path.read_text()
        for old, new in damages:
            assert old in whole
            path.write_text(whole.replace(old, new, 1))
            refused(path, "densify the key again", run=run, to="splats")
        path.write_text("{")
        refused(path, "not a whole JSON file", run=run, to="splats")
        path.write_text(whole)
