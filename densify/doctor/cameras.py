# SPDX-License-Identifier: MIT
"""Check cameras: existing images, and whether depth discontinuities are on image edges.

The score of a calibration compares the strength of the image's edges at depth discontinuities of
the sweep with that at its other returns, in standard errors (after Levinson and Thrun, "Automatic
Online Calibration of Cameras and Lasers", RSS 2013).
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from densify.config.errors import InputError
from densify.doctor.findings import FINE, SUSPICIOUS, UNKNOWN, WRONG, Finding, finding
from densify.doctor.paths import CAM_AXES, changed
from densify.doctor.sample import Sample, Spot
from densify.geometry import poses
from densify.geometry.cameras import image_points
from densify.geometry.types import Bool, Camera, Float, Float32
from densify.readers.timeline import format_frames

_EDGE_M, _EDGE_SHARE = 0.6, 0.08
_NEAREST_M, _FARTHEST_M = 3.0, 50.0
_BESIDE_RAD = np.deg2rad(0.6)
_STEEPLY = 4.0  # a neighbour above or below counts as farther by this factor
_BLUR_PX, _AROUND_PX = 1.5, 25.0  # at a focal length of 700 px
_FOCAL_PX = 700.0
_NUM_OTHERS, _LEAST_SEEN = 20_000, 50
_CLEAR, _CLEARLY = 5.0, 1.25
_LEAST_PAIRS = 2
_AS_MANY = 0.5  # share of the edges at the given calibration; one object may match by chance
_SHIFT_DEG, _SHIFT_STEP_DEG, _OFF_DEG = 2.0, 0.1, 0.4
_CLOCK_S, _CLOCK_STEP_S, _CLOCK_OFF_S = 0.2, 0.01, 0.02
_LEAST_SPEED_M_S = 3.0


@dataclass(frozen=True)
class Pair:
    """A sweep and an image taken near it.

    Attributes:
        points: (N,3) lidar frame, deskewed.
        edge: (N,) on the near side of a depth discontinuity.
        twist: (6,) of the lidar, per second.
        exposed_s: Since the reference time of the sweep.
        strength: (H,W) of image edges, relative to those around.
    """

    points: Float
    edge: Bool
    twist: Float
    exposed_s: float
    strength: Float32

    def seen_at(self, later_s: float) -> Float:
        """Return (N,3) in the lidar frame at the exposure and ``later_s``."""
        return poses.transform(
            poses.inverse(poses.exp((self.exposed_s + later_s) * self.twist)), self.points
        )


def check_cameras(sample: Sample) -> list[Finding]:
    """Check the images, the calibration and the clock of every camera."""
    if not sample.sequence.cameras:
        return [finding("cameras", FINE, "none: the cloud and the scores alone")]
    findings = []
    for camera in sample.sequence.cameras.values():
        findings.append(_check_images(sample, camera))
        pairs, broken = image_pairs(sample, camera)
        if broken:
            remedy = "fetch the image again, or give size and calibration of images like it"
            findings.append(finding(f"{camera.name}: images", WRONG, broken, remedy))
        if pairs:
            findings += _check_calibration(camera, pairs)
    return findings


def _check_images(sample: Sample, camera: Camera) -> Finding:
    name, timeline = f"{camera.name}: images", sample.timeline
    exposed_ns = np.array(sorted(sample.sequence.image_stamps_ns(camera.name).values()), np.int64)
    if not len(exposed_ns):
        remedy = f"leave the camera out (--camera with the others), or fetch {camera.name}"
        return finding(name, SUSPICIOUS, "not a single image", remedy)
    images = cKDTree(exposed_ns[:, None] - exposed_ns[0])
    nearest = np.asarray(images.query(timeline.stamp_ns[:, None] - exposed_ns[0])[0])
    without = [f for f, ns in zip(timeline.frames, nearest, strict=True) if ns > timeline.period_ns]
    apart_ms = float(np.median(nearest)) * 1e-6
    text = f"{len(exposed_ns)}, usually {apart_ms:.1f} ms from a sweep's reference time"
    verdict, remedy = FINE, "choose other keys than these"
    if without:
        verdict = SUSPICIOUS
        text += f"; {len(without)} sweeps have none within a period: {format_frames(without)}"
    if len(without) == len(timeline.frames):
        verdict, remedy = WRONG, "put sweeps and images on one clock"
    values = {"num_images": len(exposed_ns), "num_without": len(without), "apart_ms": apart_ms}
    return finding(name, verdict, text, remedy, **values)


def image_pairs(sample: Sample, camera: Camera) -> tuple[list[Pair], str]:
    """Return a sweep of each registered spot with its nearest image, and why one cannot be read."""
    exposed_ns = sample.sequence.image_stamps_ns(camera.name)
    pairs: list[Pair] = []
    for spot in sample.registered:
        row, number = min(
            ((r, n) for r in range(1, len(spot.sweeps)) for n in exposed_ns),
            key=lambda rn: abs(exposed_ns[rn[1]] - spot.sweeps[rn[0]].stamp_ns),
            default=(0, -1),
        )
        if number < 0:
            break
        apart_s = (exposed_ns[number] - spot.sweeps[row].stamp_ns) * 1e-9
        if abs(apart_s) > sample.timeline.period_ns * 1e-9:
            continue
        try:
            image = sample.sequence.image(camera.name, number)
        except InputError as error:
            return pairs, str(error)
        pairs.append(_pair(spot, row, image, apart_s, camera))
    return pairs, ""


def _pair(spot: Spot, row: int, image: NDArray[np.uint8], apart_s: float, camera: Camera) -> Pair:
    registered = spot.stretch.sweeps[row]
    range_m = np.linalg.norm(registered.sweep.points, axis=1)
    sweep = registered.sweep.select((range_m > _NEAREST_M) & (range_m < 2 * _FARTHEST_M))
    points, edge = sweep.points, np.zeros(len(sweep), bool)
    for lidar in np.unique(sweep.lidar):
        mine = sweep.lidar == lidar
        edge[mine] = depth_edges(
            (points[mine] - sweep.origin_m(int(lidar))) @ sweep.axes(int(lidar)).T
        )
    some = edge.copy()
    some[:: len(points) // _NUM_OTHERS + 1] = True
    twist = registered.twist_after if apart_s > 0 else registered.twist_before
    strength = edge_strength(image, camera.focal_px)
    return Pair(points[some], edge[some], twist, apart_s, strength)


def depth_edges(points: Float) -> Bool:
    """Return (N,) True where a return right beside the point is much farther.

    Args:
        points: (N,3) of one scanner, in its frame.
    """
    x, y, z = points.T
    range_m = np.linalg.norm(points, axis=1)
    seen = np.column_stack([np.arctan2(y, x), _STEEPLY * np.arcsin(z / range_m)])
    _, beside = cKDTree(seen).query(seen, k=5, distance_upper_bound=_BESIDE_RAD, workers=-1)
    far_m = np.append(range_m, 0.0)[beside].max(axis=1)
    edge: Bool = (far_m - range_m > np.maximum(_EDGE_M, _EDGE_SHARE * range_m)) & (
        range_m < _FARTHEST_M
    )
    return edge


def edge_strength(image: NDArray[np.uint8], focal_px: float) -> Float32:
    """Return (H,W) the size of the gradient relative to that around, at most 4, of an image."""
    scale = focal_px / _FOCAL_PX
    gray = cv2.GaussianBlur(cv2.cvtColor(image, cv2.COLOR_RGB2GRAY), (0, 0), max(0.8, scale))
    x, y = (cv2.Sobel(gray, cv2.CV_32F, *order) for order in ((1, 0), (0, 1)))
    size = cv2.blur(cv2.magnitude(x, y), (2 * round(_BLUR_PX * scale) + 1,) * 2)
    around = cv2.GaussianBlur(size, (0, 0), _AROUND_PX * scale)
    strength: Float32 = np.minimum(size / (around + 4.0), 4.0)
    return strength


def score(
    camera: Camera, pairs: list[Pair], later_s: float = 0.0, right_px: float = 0.0
) -> tuple[float, int]:
    """Return the score of a calibration over all pairs, and the number of depth discontinuities.

    The score is in standard errors. It is 0 if too few points are in view.

    Args:
        later_s: Delay of the images' clock.
        right_px: Shift of the depth in the images.
    """
    on, off, num_edges = [], [], 0
    for pair in pairs:
        points = poses.transform(camera.T_cam_lidar, pair.seen_at(later_s))
        uv, seen = image_points(camera, points)
        column, line = np.rint(uv[seen] + (right_px, 0.0)).astype(np.int64).T
        inside, edge = (column >= 0) & (column < camera.width_px), pair.edge[seen]
        num_edges += int(edge.sum())
        value = pair.strength[line[inside], column[inside]]
        on.append(value[edge[inside]])
        off.append(value[~edge[inside]])
    edged, other = np.concatenate(on), np.concatenate(off)
    if min(len(edged), len(other)) < _LEAST_SEEN:
        return 0.0, num_edges
    error = other.std() / np.sqrt(len(edged)) + 1e-9
    return float((edged.mean() - other.mean()) / error), num_edges


def alternatives(T: Float) -> dict[str, Float]:
    """Return the name of each usual mistake and ``T_cam_lidar`` (4,4) without it."""
    turned = np.array([[0.0, 1, 0, 0], [-1, 0, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]])
    return {
        "the inverse of the given pose (T_lidar_cam instead of T_cam_lidar)": poses.inverse(T),
        "a camera whose pose is that of a body (x forward, y left, z up)": CAM_AXES @ T,
        "the pose for a lidar with x right, y forward": T @ turned,
        "the transposed rotation": changed(np.transpose)(T),
    }


def _check_calibration(camera: Camera, pairs: list[Pair]) -> list[Finding]:
    """Compare the calibration and the clock as given with others. The best of all explains most."""
    given, num_given = score(camera, pairs)
    name, text = f"{camera.name}: calibration", "depth discontinuities are on image edges by"
    text += f" {given:.1f} standard errors as given"
    if len(pairs) < _LEAST_PAIRS:
        is_clear = given >= _CLEAR
        text += ": one image is too little to tell" * (not is_clear)
        return [finding(name, FINE if is_clear else UNKNOWN, text, given=given)]
    others = {}
    for what, T_cam_lidar in alternatives(camera.T_cam_lidar).items():
        at_mended, num_edges = score(replace(camera, T_cam_lidar=T_cam_lidar), pairs)
        others[what] = at_mended if num_edges > _AS_MANY * num_given else 0.0
    best = max(others, key=lambda what: others[what])
    # Discontinuities within one ring are upright. Vertical shifts are hardly observable.
    shifts_deg = np.arange(-_SHIFT_DEG, _SHIFT_DEG + 1e-9, _SHIFT_STEP_DEG)
    px_per_deg = camera.focal_px * np.pi / 180
    at_shifts = [score(camera, pairs, 0.0, shift * px_per_deg)[0] for shift in shifts_deg]
    row = int(np.argmax(at_shifts))
    shift_deg, at_shift = float(shifts_deg[row]), at_shifts[row]
    at_clock, clock = _check_clock(
        camera, pairs, max(_CLEAR, _CLEARLY * given, *others.values(), at_shift)
    )
    most, clearly = max(others[best], at_shift, at_clock), max(_CLEAR, _CLEARLY * given)
    verdict, remedy = SUSPICIOUS, "correct T_cam_lidar or K"
    if others[best] == most > clearly:
        verdict, remedy = WRONG, "correct T_cam_lidar"
        text += f", by {most:.1f} with {best}"
    elif at_shift == most > clearly and abs(shift_deg) > _OFF_DEG:
        side = "right" if shift_deg > 0 else "left"
        text += f", by {most:.1f} if they were {abs(shift_deg):.1f} deg farther to the {side}"
    elif most < _CLEAR:
        remedy = "check T_cam_lidar, K and the clocks"
        text += f", and nowhere around by more than {most:.1f}: images and sweeps do not show the"
        text += " same, or too little"
    else:
        verdict = FINE
        text += f", by {at_shift:.1f} {abs(shift_deg):.1f} deg beside"
    values = {"given": given, "best_other": others[best], "shift_deg": shift_deg}
    values |= {"at_shift": at_shift, "at_clock": at_clock}
    return [finding(name, verdict, text, remedy, **values), *clock]


def _check_clock(camera: Camera, pairs: list[Pair], clearly: float) -> tuple[float, list[Finding]]:
    """Measure the difference between the clocks of camera and lidar.

    Return the score with the best clock, 0 without one, and the finding. There is none if the
    vehicle is too slow, or too few images exist. clearly: the least score of the best clock at
    which it is said to be off.
    """
    moving = [p for p in pairs if np.linalg.norm(p.twist[3:]) > _LEAST_SPEED_M_S]
    if len(moving) < _LEAST_PAIRS:
        return 0.0, []
    times_s = np.arange(-_CLOCK_S, _CLOCK_S + 1e-9, _CLOCK_STEP_S)
    scores = np.array([score(camera, moving, later_s=t)[0] for t in times_s])
    best = float(scores.max())
    good = times_s[scores > best - max(1.0, 0.05 * best)]
    late_s, low_s, high_s = (float(t) for t in (times_s[np.argmax(scores)], good.min(), good.max()))
    text = (
        f"depth and image fit best {late_s * 1e3:+.0f} ms ({low_s * 1e3:+.0f} to "
        f"{high_s * 1e3:+.0f}) after the image's stamp"
    )
    is_off = best > clearly and (low_s > _CLOCK_OFF_S or high_s < -_CLOCK_OFF_S)
    verdict = SUSPICIOUS if is_off else FINE
    remedy = f"shift the stamps of {camera.name} by {late_s * 1e3:+.0f} ms"
    values = {"late_s": late_s, "low_s": low_s, "high_s": high_s, "best": best}
    return best, [finding(f"{camera.name}: clock", verdict, text, remedy, **values)]
