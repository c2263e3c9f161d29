# SPDX-License-Identifier: MIT
"""Exports with cameras: COLMAP's own reader, nerfstudio's format, and where points land."""

from __future__ import annotations

import json

import cv2
import numpy as np
import pytest
from plyfile import PlyData
from scipy.ndimage import map_coordinates

from densify.geometry.cameras import image_points
from densify.outputs import export_run, read_cloud, read_depth_png
from tests.exported import street_result, write_street, write_views
from tests.test_export import H, W, refused

TWO = {"image_02": "plain", "image_03": "bent"}


@pytest.fixture
def put(tmp_path):
    return lambda lenses=TWO, **options: write_views(tmp_path, lenses, **options)


@pytest.fixture(scope="module")
def street(tmp_path_factory):
    return write_street(tmp_path_factory.mktemp("street"))


def colmap(run, **arguments):
    export_run(run, to="colmap", **arguments)
    return run / "export" / "colmap"


def transforms(run, **arguments):
    export_run(run, to="nerfstudio", **arguments)
    return json.loads((run / "export" / "nerfstudio" / "transforms.json").read_text())


def read_text(folder):
    """COLMAP's text format by its description: cameras, images and points by number."""

    def lines(name):
        return (folder / f"{name}.txt").read_text().splitlines()

    cameras = {}
    for line in lines("cameras"):
        number, model, width, height, *params = line.split()
        cameras[int(number)] = (model, int(width), int(height), [float(p) for p in params])
    images, rows = {}, lines("images")
    for line, points in zip(rows[::2], rows[1::2], strict=True):
        number, *pose, camera, name = line.split()
        assert points == ""
        images[int(number)] = ([float(p) for p in pose], int(camera), name)
    points = np.array([line.split() for line in lines("points3D")], float)
    return cameras, images, points


# --- COLMAP ---------------------------------------------------------------------------------------


@pytest.mark.parametrize("lens", ["plain", "bent", "bent5", "bent8", "fisheye"])
def test_a_model_by_colmaps_own_reader(put, lens):
    pycolmap = pytest.importorskip("pycolmap")
    run, result = put({"image_02": lens, "image_03": "plain"})
    folder = colmap(run)
    for place in (folder / "sparse" / "0", folder / "text"):
        model = pycolmap.Reconstruction(str(place))
        assert sorted(image.name for image in model.images.values()) == [
            "image_02.jpg",
            "image_03.jpg",
        ]
        for image in model.images.values():
            view = result.views[image.name.removesuffix(".jpg")]
            T_cam_world = image.cam_from_world().matrix()
            np.testing.assert_allclose(T_cam_world, view.T_cam_key[:3], atol=1e-12)
            ours, camera = view.camera, model.cameras[image.camera_id]
            assert (camera.width, camera.height) == (W, H)
            rng = np.random.default_rng(0)
            points_cam = rng.uniform([-0.4, -0.3, 1], [0.4, 0.3, 1], (50, 3)) * 7
            uv, _ = image_points(ours, points_cam)
            np.testing.assert_allclose(camera.img_from_cam(points_cam), uv + 0.5, atol=1e-6)
        cloud = read_cloud(run / "cloud.laz")
        seen = cloud.rgb.any(axis=1)
        assert 0 < seen.sum() == len(model.points3D)
        places = np.array([model.points3D[i].xyz for i in sorted(model.points3D)])
        colours = np.array([model.points3D[i].color for i in sorted(model.points3D)])
        np.testing.assert_allclose(places, cloud.points[seen], atol=1e-9)
        np.testing.assert_array_equal(colours, cloud.rgb[seen])


def test_the_text_by_its_description(put):
    run, result = put()
    cameras, images, points = read_text(colmap(run) / "text")
    assert [model for model, *_ in cameras.values()] == ["PINHOLE", "OPENCV"]
    assert cameras[1] == ("PINHOLE", W, H, [17.25, 18.5, 9.625, 6.25])
    assert cameras[2][3][4:] == [-0.31, 0.12, 0.001, -0.002]
    for pose, camera, name in images.values():
        w, x, y, z = pose[:4]
        R = np.array(
            [
                [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
                [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
                [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
            ]
        )
        T_cam_key = result.views[name.removesuffix(".jpg")].T_cam_key
        np.testing.assert_allclose(R, T_cam_key[:3, :3], atol=1e-12)
        np.testing.assert_allclose(pose[4:], T_cam_key[:3, 3], atol=1e-12)
        assert cameras[camera][0] == ("PINHOLE" if name == "image_02.jpg" else "OPENCV")
    cloud = read_cloud(run / "cloud.laz")
    seen = cloud.rgb.any(axis=1)
    np.testing.assert_allclose(points[:, 1:4], cloud.points[seen], atol=1e-9)
    np.testing.assert_array_equal(points[:, 4:7], cloud.rgb[seen])
    assert not points[:, 7].any()


def test_images_of_one_camera_share_it(put):
    run, _ = put({"fast/000359": "bent", "fast/000360": "bent"})
    cameras, images, _ = read_text(colmap(run) / "text")
    assert len(cameras) == 1
    assert [(c, name) for _, c, name in images.values()] == [
        (1, "fast/000359.jpg"),
        (1, "fast/000360.jpg"),
    ]


@pytest.mark.parametrize("lens", ["prism", "mei"])
def test_lenses_that_colmap_lacks(put, lens):
    run, _ = put({"image_02": "plain", "image_03": lens})
    refused("image_03: its lens", "--camera", run=run, to="colmap")
    refused("--camera image_09: expected one of image_02, image_03", run=run, cameras=["image_09"])
    cameras, *_ = read_text(colmap(run, cameras=["image_02"]) / "text")
    assert len(cameras) == 1
    assert [p.name for p in (run / "export" / "colmap" / "images").iterdir()] == ["image_02.jpg"]


def test_points_land_on_their_depth_by_colmaps_own_camera(street):
    """Pixel centres, axes and poses at once: what COLMAP projects is where our maps have it."""
    pycolmap = pytest.importorskip("pycolmap")
    model = pycolmap.Reconstruction(str(colmap(street) / "sparse" / "0"))
    points = np.array([model.points3D[i].xyz for i in sorted(model.points3D)])
    (image,) = model.images.values()
    points_cam = image.cam_from_world() * points
    uv = model.cameras[image.camera_id].img_from_cam(points_cam)
    check_depth(street, uv, points_cam[:, 2])


def check_depth(run, uv, z_m):
    """Points lie on the map's surface, better than a third of a pixel beside: pixel (0, 0) has its
    middle at (0.5, 0.5)."""
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


def test_nerfstudio_frames(put):
    run, result = put()
    table = transforms(run)
    folder = run / "export" / "nerfstudio"
    assert table["camera_model"] == "OPENCV" and len(table["frames"]) == 2
    for frame, (name, view) in zip(table["frames"], result.views.items(), strict=True):
        assert frame["file_path"] == f"images/{name}.jpg"
        image = folder / frame["file_path"]
        assert image.read_bytes() == (run / "scene" / "image" / f"{name}.jpg").read_bytes()
        assert cv2.imread(str(image)).shape == (frame["h"], frame["w"], 3) == (H, W, 3)
        lens = [*view.camera.distortion, 0, 0, 0, 0][:4]
        assert [frame[k] for k in ("k1", "k2", "p1", "p2")] == lens and frame["k3"] == 0
        assert [frame[k] for k in ("fl_x", "fl_y", "cx", "cy")] == [17.25, 18.5, 9.625, 6.25]
        T_world_eye = np.array(frame["transform_matrix"])
        # OpenGL's camera: x right, y up, z back
        T_cam_world = np.diag([1, -1, -1, 1]) @ np.linalg.inv(T_world_eye)
        np.testing.assert_allclose(T_cam_world, view.T_cam_key, atol=1e-12)
        # As nerfstudio's get_depth_image_from_path reads it with its usual scale
        depth_m = np.load(folder / frame["depth_file_path"]) * 1e-3
        np.testing.assert_allclose(depth_m, read_depth_png(run / "depth" / f"{name}.png"), 1e-7)
    vertex = PlyData.read(folder / table["ply_file_path"])["vertex"].data
    assert vertex.dtype.names == ("x", "y", "z", "red", "green", "blue")
    cloud = read_cloud(run / "cloud.laz")
    assert len(vertex) == cloud.rgb.any(axis=1).sum() < len(cloud.points) + 1


def test_points_land_on_their_depth_by_opengls_camera(street):
    table = transforms(street)
    (frame,) = table["frames"]
    vertex = PlyData.read(street / "export" / "nerfstudio" / "cloud.ply")["vertex"].data
    points = np.stack([vertex[a] for a in "xyz"] + [np.ones(len(vertex))], axis=1)
    x, y, back, _ = (points.astype(float) @ np.linalg.inv(frame["transform_matrix"]).T).T
    z_m = -back
    u = frame["fl_x"] * x / z_m + frame["cx"]
    v = frame["cy"] - frame["fl_y"] * y / z_m
    check_depth(street, np.stack([u, v], axis=1), z_m)


def test_thresholds_and_cameras_reach_nerfstudio(put):
    run, _ = put()
    exported = export_run(run, 0.5, to="nerfstudio", cameras=["image_03"])
    assert [*exported.density] == ["image_03"] and exported.num_points is not None
    depth = np.load(run / "export" / "nerfstudio" / "depth" / "image_03.npy")
    assert np.mean(depth > 0) == exported.density["image_03"]["measured"].after < 0.4


@pytest.mark.parametrize(
    ("lenses", "words"),
    [
        ({"image_02": "plain", "image_03": "fisheye"}, ("one camera model", "--camera")),
        ({"image_02": "bent8"}, ("no lens with k4, k5, k6", "--camera")),
        ({"image_02": "mei"}, ("its lens (mei", "--camera")),
    ],
)
def test_cameras_that_nerfstudio_lacks(put, lenses, words):
    run, _ = put(lenses)
    refused(*words, run=run, to="nerfstudio")


def test_a_fisheye_in_nerfstudio(put):
    run, _ = put({"image_02": "fisheye"})
    table = transforms(run)
    assert table["camera_model"] == "OPENCV_FISHEYE"
    (frame,) = table["frames"]
    assert [frame[k] for k in ("k1", "k2", "k3", "k4")] == [0.02, -0.01, 0.003, -0.0004]


def test_ranges_are_no_depth_for_nerfstudio(put):
    run, _ = put({"image_02": "fisheye"}, measure="range")
    refused("image_02: its depth is the range", "project.depth=z", run=run, to="nerfstudio")
    colmap(run)  # has no depth


# --- damaged runs ---------------------------------------------------------------------------------


@pytest.mark.parametrize("to", ["nerfstudio", "colmap"])
def test_runs_without_images_or_scene(put, to):
    run, _ = put()
    image = run / "scene" / "image" / "image_02.jpg"
    image.write_bytes(image.read_bytes()[:-40])
    refused(image, "not a complete image", run=run, to=to)
    cv2.imwrite(str(image), np.zeros((H, W + 1, 3), np.uint8))
    refused(f"got {W + 1} x {H} px, expected {W} x {H}", run=run, to=to)
    for path in (run / "scene" / "image").iterdir():
        path.unlink()
    refused("no images in scene/image of image_02, image_03", run=run, to=to)
    (run / "scene" / "scene.json").unlink()
    refused("scene.json: not there", run=run, to=to)


DAMAGE = {
    "views": 3,
    "views.image_02": [],
    "views.image_02.K": [[1, 0, 0], [0, 1, 0]],
    "views.image_02.T_cam_key": [[1, 0, 0, "x"]] * 4,
    "views.image_02.T_cam_lidar": (2 * np.eye(4)).tolist(),
    "views.image_03.T_cam_key": np.diag([1, 1, -1, 1]).tolist(),
    "views.image_02.model": "cone",
    "views.image_02.distortion": [True],
    "views.image_02.width_px": 0,
    "views.image_02.row_time_s": None,
    "sweeps": {},
}


@pytest.mark.parametrize("place", DAMAGE)
def test_damaged_scenes_are_named(put, place):
    run, _ = put()
    path = run / "scene" / "scene.json"
    table = json.loads(path.read_text())
    *way, last = place.split(".")
    inner = table
    for name in way:
        inner = inner[name]
    inner[last] = DAMAGE[place]
    path.write_text(json.dumps(table))
    refused(path, place, "expected", run=run, to="colmap")
    path.write_text("[]")
    refused(path, "the file: expected a mapping", run=run, to="colmap")
    path.write_text("{")
    refused(path, "not a whole JSON file", run=run, to="colmap")


def test_the_street_moves():
    assert street_result().cloud.moving.sum() > 100
