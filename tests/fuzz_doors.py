# SPDX-License-Identifier: MIT
"""The doors through which what others have written comes in, each with files to begin with.

A door of single files takes one; a tree is a recording of which one file is changed, then opened
and read to the end.
"""

from __future__ import annotations

import gzip
import io
import json
import os
import shutil
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from densify.config.errors import ComputationError, InputError

ALLOWED = (InputError, ComputationError)
FRAMES = (59, 60, 61)  # as in the tests of readers: rendered once for all
FORMATS = (
    *("kitti", "folder", "ros1", "ros2", "argoverse2", "kitti-odometry", "kitti-tracking"),
    *("kitti-360", "nuscenes", "opensceneflow", "waymo", "dgp", "pandaset"),
)


@dataclass(frozen=True)
class Door:
    """use: reads the file or the recording at a place. seeds: files to change, by name (of a tree:
    relative to ``home``). home: of a tree, a copy that may be changed."""

    name: str
    use: Callable[[Path], Any]
    seeds: dict[str, bytes]
    home: Path | None = None

    def attempt(self, name: str, content: bytes, scratch: Path) -> None:
        """With one file so. Raises whatever the door does."""
        if self.home is None:
            path = scratch / name
            path.write_bytes(content)
            try:
                self.use(path)
            finally:
                path.unlink()
            return
        path = self.home / name
        path.write_bytes(content)
        try:
            self.use(self.home)
        finally:
            path.write_bytes(self.seeds[name])


# Files


def _image(path: Path) -> None:
    from densify.readers.decoded_files import read_image

    read_image(path, as_stored=path.suffix == ".png")


def _npy(path: Path) -> None:
    from densify.readers.decoded_files import read_array

    read_array(path)


def _npz(path: Path) -> None:
    from densify.readers.decoded_files import read_arrays

    read_arrays(path)


def _points(path: Path) -> None:
    from densify.cli.point_files import read_points
    from densify.readers.point_files import read_table, read_viewpoint

    for read in (read_table, read_viewpoint, read_points):
        try:
            read(path)
        except ALLOWED:
            if read is read_points:
                raise


def _flow(path: Path) -> None:
    from densify.readers.flow_files import load_flow_file

    load_flow_file(path)


def _prior(path: Path) -> None:
    from densify.geometry.types import Camera
    from densify.readers.prior_files import PriorFiles

    camera = Camera("cam", 12, 8, np.eye(3), np.eye(4))
    PriorFiles.open(path.parent, ["cam"]).prior(camera, 5)


def _json(path: Path) -> None:
    from densify.config.file_content import read_json

    read_json(path)


def _config(path: Path) -> None:
    from densify.config import resolve

    resolve(path)


def _override(path: Path) -> None:
    from densify.config import resolve

    resolve(None, [os.fsdecode(path.read_bytes())])


def _words(path: Path) -> None:
    """A command line, one word to a line; parsed, not run."""
    from densify.cli.arguments import parse

    try:
        parse(os.fsdecode(path.read_bytes()).split("\n"))
    except SystemExit as end:
        if end.code not in (0, 2):
            raise


def _spec(path: Path) -> None:
    from densify.readers import Spec
    from densify.readers.street import Street

    spec = Spec.parse(os.fsdecode(path.read_bytes()))
    if spec.reader == "street":
        Street.from_spec(spec.place)


def _stamps(path: Path) -> None:
    from densify.readers.kitti.calibration import Stamps
    from densify.readers.stamp_files import StampFile

    for read in (Stamps.read, StampFile.read):
        try:
            read(path)
        except ALLOWED:
            if read is not Stamps.read:
                raise


def _poses(path: Path) -> None:
    from densify.readers.pose_files import PoseFile

    PoseFile.read(path)


def _cloud(path: Path) -> None:
    from densify.outputs import read_cloud

    read_cloud(path)


def _scene(path: Path) -> None:
    from densify.outputs.scene_file import read_scene

    read_scene(path)


def _movers(path: Path) -> None:
    from densify.outputs.scene_file import read_tracks

    read_tracks(path)


def _gzip(path: Path) -> None:
    from densify.config.file_content import gunzipped, read_bytes

    gunzipped(read_bytes(path), path, 1 << 24)


def _saved(save: Callable[..., None], *arrays: Any, **named: Any) -> bytes:
    buffer = io.BytesIO()
    save(buffer, *arrays, **named)
    return buffer.getvalue()


def _file_doors() -> Iterator[Door]:
    rng = np.random.default_rng(0)
    image = cv2.GaussianBlur(rng.integers(0, 255, (8, 12, 3), np.uint8), (3, 3), 0)
    deep = rng.integers(0, 60_000, (8, 12), np.uint16)
    points = rng.normal(0, 20, (40, 4)).astype("<f4")
    png, jpeg = (cv2.imencode(s, image)[1].tobytes() for s in (".png", ".jpg"))
    depth = cv2.imencode(".png", deep)[1].tobytes()
    yield Door("images", _image, {"a.png": png, "b.png": depth, "c.jpg": jpeg})
    yield Door("npy", _npy, {"a.npy": _saved(np.save, points), "b.npy": _saved(np.save, deep)})
    arrays = {"points": points[:, :3], "offset_ns": np.arange(40), "lidar": np.zeros(40, np.uint8)}
    npz = {f"{f.__name__}.npz": _saved(f, **arrays) for f in (np.savez, np.savez_compressed)}
    yield Door("npz", _npz, npz)
    yield Door("points", _points, npz | _point_files(points))
    flow = {"row": np.arange(40), "residual_flow": points[:, :3], "moving": points[:, 3] > 0}
    yield Door("flow", _flow, {"000001_000002.npz": _saved(np.savez_compressed, **flow)})
    yield Door("prior", _prior, {"5.npy": _saved(np.save, deep.astype(np.float32)), "5.png": depth})
    yield Door("json", _json, {"a.json": b'{"a": [1, 2.5, null, {"b": "c"}], "d": {"e": true}}'})
    configs = Path(__file__).parents[1] / "configs"
    yield Door("config", _config, {p.name: p.read_bytes() for p in configs.glob("*.yaml")})
    knobs = (b"project.support=2", b"flow.engine=groups", b"register.deskew=false")
    yield Door("override", _override, {f"{i}.txt": knob for i, knob in enumerate(knobs)})
    yield Door("words", _words, {f"{w[0]}.txt": "\n".join(w).encode() for w in _COMMANDS})
    specs = (b"street:crossing?seed=7&sensor=vlp16&hz=20&tilt=10&cameras=fast", b"kitti:a/b#c")
    yield Door("spec", _spec, {f"{i}.txt": spec for i, spec in enumerate(specs)})
    stamps = "".join(f"2011-09-26 13:10:{n:02d}.158069617\n" for n in range(9))
    table = "# frame time\n" + "".join(f"{n} {1.3e9 + n / 10:.9f}\n" for n in range(9))
    yield Door("stamps", _stamps, {"a.txt": stamps.encode(), "b.txt": table.encode()})
    kitti = "".join(f"1 0 0 {n} 0 1 0 0 0 0 1 0\n" for n in range(5))
    tum = "".join(f"{1.3e9 + n / 10:.3f} {n} 0 0 0 0 0 1\n" for n in range(5))
    yield Door("poses", _poses, {"a.txt": kitti.encode(), "b.txt": tum.encode()})
    yield Door("cloud", _cloud, {"cloud.laz": _laz(points)})
    T = np.eye(4).tolist()
    view = {"name": "a", "width_px": 9, "height_px": 5, "K": np.eye(3).tolist(), "T_cam_lidar": T}
    view |= {"distortion": [0.1, 0.2], "model": "pinhole", "row_time_s": 0, "column_time_s": 0.0}
    scene = {
        "views": {"a": {**view, "T_cam_key": T, "late_s": 0.1, "number": 4}},
        "sweeps": [{"frame": 3, "T_key_lidar": T}, {"frame": 4, "T_key_lidar": None}],
    }
    yield Door("scene", _scene, {"scene.json": json.dumps(scene).encode()})
    pose = {"frame": 3, "stamp_ns": 10**18, "num_points": 9, "T_key_object": T}
    track = {"instance": 2, "size_m": [4, 2, 1.5], "poses": [{**pose, "velocity_m_s": [1, 2, 0]}]}
    yield Door("movers", _movers, {"movers.json": json.dumps({"objects": [track]}).encode()})
    yield Door("gzip", _gzip, {"a.gz": gzip.compress(points.tobytes())})


_COMMANDS = (
    ("run", "--key", "12", "--keys", "3:9:2", "--window", "5", "--set", "a.b=1", "--cache"),
    ("dataset", "--keys", "1:5", "--workers", "2", "--shard", "1/4"),
    ("flow", "a.npz", "b.npz", "--out", "c.npz"),
    ("simulate", "--out", "x", "--frames", "1:5", "--tilt", "10", "--seed", "3"),
    ("evaluate", "a", "b", "--focal-px", "700"),
)


def _point_files(points: np.ndarray) -> dict[str, bytes]:
    rows = "\n".join(" ".join(f"{v:.3f}" for v in row) for row in points)
    header = (
        "# .PCD v0.7\nVERSION 0.7\nFIELDS x y z intensity\nSIZE 4 4 4 4\nTYPE F F F F\n"
        "COUNT 1 1 1 1\nWIDTH 40\nHEIGHT 1\nVIEWPOINT 0 0 0 1 0 0 0\nPOINTS 40\nDATA {}\n"
    )
    ply = "ply\nformat ascii 1.0\nelement vertex 40\n" + "".join(
        f"property float {name}\n" for name in ("x", "y", "z", "intensity")
    )
    return {
        "a.bin": points.tobytes(),
        "a.npy": _saved(np.save, points),
        "a.txt": rows.encode(),
        "a.csv": ("x,y,z,i\n" + rows.replace(" ", ",")).encode(),
        "a.pcd": header.format("ascii").encode() + rows.encode(),
        "b.pcd": header.format("binary").encode() + points.tobytes(),
        "a.ply": (ply + "end_header\n" + rows + "\n").encode(),
        "a.laz": _laz(points),
        "a.las": _laz(points, compressed=False),
    }


def _laz(points: np.ndarray, compressed: bool = True) -> bytes:
    import laspy

    names = ("frame", "moving", "instance", "confidence", "displaced", "far")
    kinds = ("int32", "uint8", "int32", "float32", "float32", "uint8")
    header = laspy.LasHeader(version="1.4", point_format=7)
    header.scales = np.full(3, 0.001)
    header.add_extra_dims([laspy.ExtraBytesParams(n, k) for n, k in zip(names, kinds, strict=True)])
    las = laspy.LasData(header)
    las.xyz = points[:, :3]
    buffer = io.BytesIO()
    las.write(buffer, do_compress=compressed)
    return buffer.getvalue()


# Trees


def _read_all(place: Path) -> None:
    """All that a run might read."""
    from densify.geometry.types import KnowsBoxes
    from densify.readers import open_sequence
    from densify.readers.describe import describe

    sequence = open_sequence(_opened_as(place))
    steps: list[Callable[[], Any]] = [lambda: describe(sequence)]
    for frame in list(sequence.frames)[:4]:
        steps += [lambda f=frame: sequence[f], lambda f=frame: sequence.T_world_lidar(f)]
        if isinstance(sequence, KnowsBoxes):
            steps.append(lambda f=frame: sequence.boxes(f))
    for camera in list(sequence.cameras)[:2]:
        numbers = list(sequence.image_stamps_ns(camera))[:2]
        steps += [lambda c=camera, n=number: sequence.image(c, n) for number in numbers]
    _try_each(steps)


def _try_each(steps: list[Callable[[], Any]]) -> None:
    """All of them; raises the last refusal."""
    refused = None
    for step in steps:
        try:
            step()
        except ALLOWED as error:
            refused = error
    if refused is not None:
        raise refused


_PLACES: dict[Path, str] = {}


def _opened_as(place: Path) -> str:
    return _PLACES[place]


def _set(place: Path) -> None:
    """A training set: what `dataset` and `DepthDataset` read of it."""
    from densify.dataset.loader import DepthDataset
    from densify.dataset.make import damaged, status

    status(place)
    damaged(place)
    _try_each([lambda: _page(place), lambda: _samples(DepthDataset(place))])


def _samples(data: Any) -> None:
    for index in range(min(2, len(data))):
        data[index]


def _run(place: Path) -> None:
    """A finished run: its page, and what is exported of it."""
    from densify.config.plugins.exports import EXPORTS
    from densify.outputs import export_run

    out = place.with_name("exported")
    try:
        _try_each(
            [
                lambda: _page(place),
                *(
                    lambda to=n: export_run(place, to, out / to, min_confidence=0.3)
                    for n in [row.name for row in EXPORTS]
                ),
            ]
        )
    finally:
        shutil.rmtree(out, ignore_errors=True)


def _page(place: Path) -> None:
    from densify.dataset.report import write_report

    write_report(place, place.with_name("report.html"), overwrite=True)


def _tree(name: str, home: Path, place: str, use: Callable[[Path], Any]) -> Door:
    for path in home.rglob("truth"):
        shutil.rmtree(path)
    files = sorted(p for p in home.rglob("*") if p.is_file())
    seeds = {p.relative_to(home).as_posix(): p.read_bytes() for p in files}
    _PLACES[home] = place
    return Door(name, use, seeds, home)


@cache
def door(name: str, root: Path) -> Door:
    """root: a folder for what trees need."""
    if name in _REAL:
        return _real(name, root)
    if name in FORMATS:
        return _written(name, root)
    if name in ("set", "run"):
        return _made(name, root)
    return next(door for door in _file_doors() if door.name == name)


def file_doors() -> list[str]:
    return [door.name for door in _file_doors()]


def trees() -> list[str]:
    return [*FORMATS, "set", "run"]


def real_trees() -> list[str]:
    """Of real recordings, where there are some."""
    data = Path(os.environ.get("DENSIFY_TEST_DATA", "/nowhere"))
    return [n for n, (folder, inside, _) in _REAL.items() if (data / folder / inside).is_dir()]


def _written(format: str, root: Path) -> Door:
    from writers import write_street

    from densify.readers.street import Street

    sensor, hz, frames = {
        "nuscenes": ("hdl32", 20, (119, 120, 121)),
        "pandaset": ("pandaset", 10, FRAMES),
    }.get(format, ("vlp16", 10, FRAMES))
    street = Street("street", 0, sensor, hz=hz, cameras=("image_02",))
    home = root / format
    return _tree(format, home, str(write_street(format, street, home, frames)), _read_all)


def _made(name: str, root: Path) -> Door:
    from tests.command import exit_code
    from tests.dataset_scenes import OPTIONS, across_border, write_drive

    drive = write_drive(across_border(), root / f"of-{name}" / "2011_09_26")
    options = ("--data", str(drive), *OPTIONS, "--method", "none")
    keys, out = {"set": ("--keys", "39:41"), "run": ("--key", "40")}[name], root / name
    if exit_code("dataset" if name == "set" else "run", *options, *keys, "--out", out):
        raise RuntimeError(f"no {name} could be made")
    if name == "run":
        return _tree(name, out / "000040", "", _run)
    (out / "densify.log").unlink()
    return _tree(name, out, "", _set)


_REAL = {
    "real kitti": ("kitti/2011_09_26", "2011_09_26_drive_0002_sync", 4),
    "real nuscenes": ("nuscenes", "", 9),
    "real ddad": ("ddad", "", 9),
    "real argoverse2": ("argoverse2", "sensor/val/7fab2350-7eaf-3b7e-a39d-6937a4c1bede", 4),
}
"""Folder of test data -> what ``--data`` is in it, and how many files of a folder are copied."""


def _real(name: str, root: Path) -> Door:
    """Copied for the time of the run."""
    folder, inside, most = _REAL[name]
    source, home = Path(os.environ["DENSIFY_TEST_DATA"]) / folder, root / name.replace(" ", "-")
    for place, _, files in os.walk(source):
        if "drive" in place and inside not in place:
            continue
        target = home / Path(place).relative_to(source)
        target.mkdir(parents=True, exist_ok=True)
        for file in sorted(files)[:most] if len(files) > 12 else files:
            shutil.copyfile(Path(place, file), target / file)
    return _tree(name, home, str(home / inside), _read_all)
