# SPDX-License-Identifier: MIT
"""Writes a street as a DGP scene, which `densify.readers.dgp` opens::

    OUT/scene_01/{scene_<hash>.json, calibration/<hash>.json}
    OUT/scene_01/point_cloud/LIDAR/<stamp>.npz    OUT/scene_01/rgb/image_02/<stamp>.png
    OUT/scene_01/truth/  as in `densify.readers.truth_files`

Stamps are a tenth of a microsecond taken for a microsecond, as DDAD's are. Points are compensated
to the middle of the sweep with the street's true path, and in the scanner's frame, whose place on
the vehicle the calibration has.
"""

from __future__ import annotations

import hashlib
import io
import json
from datetime import datetime, timedelta, timezone
from pathlib import Path
from typing import Any

import numpy as np

from densify.config.errors import InputError
from densify.geometry import poses
from densify.geometry.types import Float
from densify.outputs.writers.excerpt import (
    Excerpt,
    check_plain_cameras,
    new_folder,
    put,
    quaternion,
)

_T_EGO_LIDAR = np.eye(4)
_T_EGO_LIDAR[:3, 3] = [1.1, 0.0, 1.73]
_LIDAR = "LIDAR"


def write_tree(excerpt: Excerpt, out: Path, overwrite: bool) -> Path:
    """See `TreeWriter`. The format has room for rectified cameras and for one
    scanner."""
    street = excerpt.street
    check_plain_cameras(excerpt, "DGP")
    if len(street.simulator.sensor.scanners) > 1:
        raise InputError(
            f"{street.name}: cannot be written as DGP, whose points do not say which scanner "
            f"measured them; choose a sensor of one scanner such as hdl64"
        )
    path = excerpt.poses()
    stamps_ns = [street.stamp_ns(frame) for frame in excerpt.frames]
    data, samples = [], []
    with new_folder(out / "scene_01", overwrite) as folder:
        calibration = _calibration(excerpt)
        calibration_key = hashlib.sha1(calibration).hexdigest()
        put(folder / "calibration" / f"{calibration_key}.json", calibration)
        for done, frame in excerpt.numbered():
            returns = excerpt.returns(frame)
            fired = returns.points.astype(np.float64)
            points = path.compensated(fired, stamps_ns[done], returns.offset_ns)
            file, stamp_ns = io.BytesIO(), stamps_ns[done]
            np.savez_compressed(file, data=np.column_stack([points, returns.intensity]))
            name = f"point_cloud/{_LIDAR}/{stamp_ns // 100}.npz"
            put(folder / name, file.getvalue())
            fields = {"point_format": ["X", "Y", "Z", "INTENSITY"], "point_fields": []}
            T = excerpt.T_world_ego(np.array([stamp_ns]))[0]
            data.append(_datum("point_cloud", _LIDAR, stamp_ns, name, T, fields))
            samples.append(_sample(calibration_key, stamp_ns, [data[-1]["key"]]))
        for camera in excerpt.cameras:
            for number, image in enumerate(excerpt.image_numbers(camera)):
                data.append(_write_image(folder, excerpt, camera, image))
                sample = samples[min(number, len(samples) - 1)]
                sample["datum_keys"].append(data[-1]["key"])
        scene = {"name": "", "log": "", "metadata": {}, "data": data, "samples": samples}
        text = json.dumps(scene).encode()
        put(folder / f"scene_{hashlib.sha1(text).hexdigest()}.json", text)
        excerpt.write_truth(folder / "truth", stamps_ns)
    return out / "scene_01"


def _write_image(folder: Path, excerpt: Excerpt, camera: str, image: int) -> dict[str, Any]:
    of = excerpt.street.cameras[camera]
    stamp_ns = excerpt.street.image_stamps_ns(camera)[image]
    name = f"rgb/{camera}/{stamp_ns // 100}.png"
    put(folder / name, excerpt.encoded_image(camera, image))
    size = {"width": of.width_px, "height": of.height_px, "channels": 3}
    T = excerpt.T_world_ego(np.array([stamp_ns]), poses.inverse(of.T_cam_lidar))[0]
    return _datum("image", camera, stamp_ns, name, T, size)


def _datum(
    kind: str, sensor: str, stamp_ns: int, file: str, T_world_sensor: Float, more: dict[str, Any]
) -> dict[str, Any]:
    return {
        "id": {"name": sensor, "timestamp": _date(stamp_ns), "index": "0", "log": ""},
        "key": hashlib.sha1(file.encode()).hexdigest(),
        "datum": {kind: {"filename": file, "pose": _pose(T_world_sensor), "metadata": {}, **more}},
        "next_key": "",
        "prev_key": "",
    }


def _sample(calibration_key: str, stamp_ns: int, keys: list[str]) -> dict[str, Any]:
    identity = {"name": "", "timestamp": _date(stamp_ns), "index": "0", "log": ""}
    return {"calibration_key": calibration_key, "datum_keys": keys, "id": identity, "metadata": {}}


def _date(stamp_ns: int) -> str:
    date = datetime(1970, 1, 1, tzinfo=timezone.utc) + timedelta(microseconds=stamp_ns // 100)
    return date.isoformat(timespec="microseconds").replace("+00:00", "Z")


def _pose(T: Float) -> dict[str, dict[str, float]]:
    turn = dict(zip(("qw", "qx", "qy", "qz"), quaternion(T).tolist(), strict=True))
    return {"rotation": turn, "translation": dict(zip("xyz", T[:3, 3].tolist(), strict=True))}


def _calibration(excerpt: Excerpt) -> bytes:
    nothing = dict.fromkeys(("fx", "fy", "cx", "cy", "skew"), 0.0)
    extrinsics, intrinsics = [_pose(_T_EGO_LIDAR)], [nothing]
    for name in excerpt.cameras:
        camera = excerpt.street.cameras[name]
        K = camera.K
        extrinsics.append(_pose(_T_EGO_LIDAR @ poses.inverse(camera.T_cam_lidar)))
        places = {"fx": K[0, 0], "fy": K[1, 1], "cx": K[0, 2], "cy": K[1, 2], "skew": 0.0}
        intrinsics.append({key: float(value) for key, value in places.items()})
    given = {
        "names": [_LIDAR, *excerpt.cameras],
        "extrinsics": extrinsics,
        "intrinsics": intrinsics,
    }
    return json.dumps(given).encode()
