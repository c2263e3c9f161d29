# SPDX-License-Identifier: MIT
"""Check cameras: missing images, and whether depth discontinuities coincide with image edges."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np
from scipy.spatial import cKDTree

from densify.config.errors import InputError
from densify.doctor.motion import CAM_AXES, change_pose
from densify.doctor.sample import FINE, SUSPICIOUS, UNKNOWN, WRONG, Finding, Sample
from densify.geometry import poses
from densify.geometry.types import Camera, Float, RegisteredSweep
from densify.readers.timeline import format_frames
from densify.scores.edge_fit import (
    Fit,
    Silhouettes,
    View,
    best_fit,
    image_edges,
    num_changed,
    score,
    silhouettes_of,
    turned,
)

_MOST_IMAGES, _LEAST_IMAGES = 36, 4  # most images of all cameras; least of one for a verdict
_CLEARLY = 1.25  # ratio of two scores from which the larger one is clearly better
_LEAST_EDGES = 0.5  # share of the edges visible as given; one object may match by chance
# Errors of rotation: suspicious, wrong, and the standard error without a verdict. An offset of
# 1 degree is 4 standard errors.
_OFF_DEG, _WRONG_DEG, _UNSURE_DEG = 0.5, 0.75, 0.25
_CLOCK_OFF_S, _CLOCK_WRONG_S = 0.02, 0.05  # errors of the clock: suspicious, wrong
_LEAST_SPEED_M_S = 3.0  # a slower vehicle does not show an error of the clock
# Names of a positive and a negative pitch, yaw and roll
_DIRECTIONS = (
    ("higher", "lower"),
    ("farther right", "farther left"),
    ("clockwise", "anticlockwise"),
)


def check_cameras(sample: Sample) -> list[Finding]:
    """Check the images, the calibration and the clock of every camera."""
    if not sample.sequence.cameras:
        lines = sample.sequence.findings() if hasattr(sample.sequence, "findings") else ()
        for name, text in lines:
            if name == "no camera":  # images, but no calibration
                remedy = "fill in these lines, or go on without depth maps"
                return [Finding("cameras", SUSPICIOUS, f"none: {text}", remedy)]
        return [Finding("cameras", FINE, "none: the cloud and the scores alone")]
    findings = []
    silhouettes: dict[int, Silhouettes] = {}  # frame -> silhouettes, shared by the cameras
    for camera in sample.sequence.cameras.values():
        findings.append(_check_images(sample, camera))
        views, read_error = camera_views(sample, camera, silhouettes)
        if read_error:
            remedy = "fetch the image again, or give size and calibration of images like it"
            findings.append(Finding(f"{camera.name}: images", WRONG, read_error, remedy))
        findings += check_calibration(camera, views)
        if findings[-1].check != f"{camera.name}: clock":
            text = "not compared, because the calibration is not known to be right"
            findings.append(Finding(f"{camera.name}: clock", UNKNOWN, text))
    return findings


def _check_images(sample: Sample, camera: Camera) -> Finding:
    """Check that every sweep has an image of the camera within a period."""
    name = f"{camera.name}: images"
    timeline = sample.timeline
    exposed_ns = np.array(sorted(sample.sequence.image_stamps_ns(camera.name).values()), np.int64)
    if not len(exposed_ns):
        remedy = f"leave the camera out (--camera with the others), or fetch {camera.name}"
        return Finding(name, SUSPICIOUS, "not a single image", remedy)
    # Times count from the first image, to keep their digits in floating point.
    tree = cKDTree(exposed_ns[:, None] - exposed_ns[0])
    nearest_ns = np.asarray(tree.query(timeline.stamp_ns[:, None] - exposed_ns[0])[0])
    lacking = [
        frame
        for frame, apart_ns in zip(timeline.frames, nearest_ns, strict=True)
        if apart_ns > timeline.period_ns
    ]
    apart_ms = float(np.median(nearest_ns)) * 1e-6
    text = f"{len(exposed_ns)}, usually {apart_ms:.1f} ms from a sweep's reference time"
    verdict, remedy = FINE, "choose other keys than these"
    if lacking:
        verdict = SUSPICIOUS
        text += f"; {len(lacking)} sweeps have none within a period: {format_frames(lacking)}"
    if len(lacking) == len(timeline.frames):
        verdict, remedy = WRONG, "put sweeps and images on one clock"
    values = {"num_images": len(exposed_ns), "num_without": len(lacking), "apart_ms": apart_ms}
    return Finding(name, verdict, text, remedy, values)


def camera_views(
    sample: Sample, camera: Camera, silhouettes: dict[int, Silhouettes]
) -> tuple[list[View], str]:
    """Return views of a camera, and the error of the first image that cannot be read, else "".

    At most max(4, 36 / number of cameras) images are read, spread over all spots, none after an
    error. ``silhouettes``, frame -> silhouettes, is extended by the frames that it lacks.
    """
    stamps_ns = sample.sequence.image_stamps_ns(camera.name)
    pairs = _pair_images(sample, stamps_ns)
    num_views = max(_LEAST_IMAGES, _MOST_IMAGES // len(sample.sequence.cameras))
    views: list[View] = []
    for row in np.unique(np.linspace(0, len(pairs) - 1, min(num_views, len(pairs))).astype(int)):
        registered, number = pairs[row]
        try:
            edges = image_edges(sample.sequence.image(camera.name, number), camera.focal_px)
        except InputError as error:
            return views, str(error)
        sweep = registered.sweep
        if sweep.frame not in silhouettes:
            silhouettes[sweep.frame] = silhouettes_of(sweep)
        apart_s = (stamps_ns[number] - sweep.stamp_ns) * 1e-9
        twist = registered.twist_after if apart_s > 0 else registered.twist_before
        views.append(View(silhouettes[sweep.frame], *edges, twist, apart_s))
    return views, ""


def _pair_images(sample: Sample, stamps_ns: Mapping[int, int]) -> list[tuple[RegisteredSweep, int]]:
    """Return registered sweeps with the number of the nearest image, if it is within a period."""
    # The first sweep of a spot has no motion before it.
    sweeps = [registered for spot in sample.registered for registered in spot.stretch.sweeps[1:]]
    pairs = []
    for registered in sweeps:
        sweep_ns = registered.sweep.stamp_ns
        nearest = min(stamps_ns, key=lambda number: abs(stamps_ns[number] - sweep_ns), default=None)
        if nearest is not None and abs(stamps_ns[nearest] - sweep_ns) <= sample.timeline.period_ns:
            pairs.append((registered, nearest))
    return pairs


def correct_common_mistakes(T_cam_lidar: Float) -> dict[str, Float]:
    """Return name of a common mistake -> ``T_cam_lidar`` (4,4) after its correction."""
    right_forward_axes = np.array([[0.0, 1, 0, 0], [-1, 0, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]])
    T_lidar_cam = poses.inverse(T_cam_lidar)
    return {
        "the inverse of the given pose (T_lidar_cam instead of T_cam_lidar)": T_lidar_cam,
        "a camera whose pose is that of a body (x forward, y left, z up)": CAM_AXES @ T_cam_lidar,
        "the pose for a lidar with x right, y forward": T_cam_lidar @ right_forward_axes,
        "the transposed rotation": change_pose(np.transpose)(T_cam_lidar),
    }


def check_calibration(camera: Camera, views: list[View]) -> list[Finding]:
    """Return findings about the calibration and, if it can be fitted, about the camera's clock."""
    name = f"{camera.name}: calibration"
    num_images = len(views)
    if num_images < _LEAST_IMAGES:
        text = f"{num_images} images near registered sweeps, {_LEAST_IMAGES} are needed to tell"
        return [Finding(name, UNKNOWN, text)]

    with_clock = any(np.linalg.norm(view.twist[3:]) > _LEAST_SPEED_M_S for view in views)
    fit = best_fit(camera, views, with_clock)
    mistake, mistake_score, T_corrected = _best_mistake(camera, views)
    values = {"score": fit.score, "clearness": fit.clearness, "other": mistake_score}
    values |= dict(zip(("pitch_deg", "yaw_deg", "roll_deg"), fit.offset.tolist(), strict=False))
    if mistake_score > _CLEARLY * max(fit.score, fit.rival, 0.0):
        text = f"depth discontinuities lie on image edges with {mistake}, and not as given"
        return [Finding(name, WRONG, text, _line_of(camera.name, T_corrected), values)]

    explanations = [_best_explanation(fit, with_clock), *map(_explanation, fit.others)]
    # Offsets that fit equally matter unless the best fit changes less than each of them.
    num_changes = num_changed(fit.others[fit.are_equal]).min(initial=2)
    is_one_of_many = fit.are_equal.any() and num_changed(fit.offset) >= min(num_changes, 2)
    is_uncertain = fit.clearness < _CLEARLY or fit.error[:2].max() > _UNSURE_DEG
    if is_one_of_many or is_uncertain:
        return [_report_ambiguous(name, fit, explanations, num_images, values)]

    calibration = _report_offset(camera, fit, explanations, num_images, values)
    if with_clock:
        return [calibration, _check_clock(camera, fit, num_images)]
    text = f"the vehicle is slower than {_LEAST_SPEED_M_S:g} m/s where it was looked at"
    return [calibration, Finding(f"{camera.name}: clock", UNKNOWN, text)]


def _report_ambiguous(
    name: str, fit: Fit, explanations: list[str], num_images: int, values: Mapping[str, float]
) -> Finding:
    """Report that no offset fits the images clearly better than others."""
    text = (
        f"no turn of up to 2.7 deg puts the depth discontinuities of {num_images} sweeps on image "
        f"edges better than others do: images and sweeps do not show the same, or too little; "
        f"the best fit: {explanations[0]}"
    )
    if len(explanations) > 1:
        text = f"{len(explanations)} explanations fit {num_images} images about equally: "
        text += "; or ".join(explanations)
    is_as_given = num_changed(fit.offset) == 0 and fit.score > fit.usual
    verdict = UNKNOWN if is_as_given or num_images < 2 * _LEAST_IMAGES else SUSPICIOUS
    remedy = (
        "check T_cam_lidar, K and the clocks, and that the images are the camera's; sweeps at "
        "rest tell a turn from a clock"
    )
    return Finding(name, verdict, text, remedy, values)


def _report_offset(
    camera: Camera, fit: Fit, explanations: list[str], num_images: int, values: Mapping[str, float]
) -> Finding:
    """Report the rotation between the given and the best calibration."""
    verdict = FINE
    text = f"{explanations[0]} (best fit of {num_images} images)"
    # An error counts if it exceeds two standard errors.
    offset_deg = np.abs(fit.offset[:3])
    excess_deg = offset_deg - 2 * fit.error[:3]
    is_off = (offset_deg > _OFF_DEG) & (excess_deg > 0)
    if is_off.any():
        verdict = WRONG if (is_off & (excess_deg > _WRONG_DEG)).any() else SUSPICIOUS
    else:
        text = f"right within {_OFF_DEG} deg: {text}"
    if len(explanations) > 1:
        text += f"; more changes at once fit about equally: {'; or '.join(explanations[1:])}"
    # Angles that are 0 within two standard errors are left as they are.
    corrected = turned(camera, np.where(np.abs(fit.offset) > 2 * fit.error, fit.offset, 0.0))
    remedy = _line_of(camera.name, corrected.T_cam_lidar)
    return Finding(f"{camera.name}: calibration", verdict, text, remedy, values)


def _line_of(name: str, T_cam_lidar: Float) -> str:
    """Return the line of a corrected calibration (4,4), and where it belongs."""
    where = f"cameras.{name} in densify.yaml, or the recording's own calibration file"
    return f"T_cam_lidar: {T_cam_lidar[:3].round(5).tolist()}  # {where}"


def _best_mistake(camera: Camera, views: list[View]) -> tuple[str, float, Float]:
    """Return the common mistake whose correction scores best, its score, and the correction."""
    num_given = score(camera, views)[1]
    scores, corrected = {}, correct_common_mistakes(camera.T_cam_lidar)
    for mistake, T_cam_lidar in corrected.items():
        mistake_score, num_edges = score(replace(camera, T_cam_lidar=T_cam_lidar), views)
        scores[mistake] = mistake_score if num_edges > _LEAST_EDGES * num_given else 0.0
    best = max(scores, key=lambda mistake: scores[mistake])
    return best, scores[best], corrected[best]


def _best_explanation(fit: Fit, with_clock: bool) -> str:
    """Return the fitted rotation and delay with their errors, as a clause."""
    turns = [
        f"{abs(turn):.2f} ± {error:.2f} deg {directions[int(turn < 0)]}"
        for turn, error, directions in zip(fit.offset, fit.error, _DIRECTIONS, strict=False)
    ]
    clock = f", images {1e3 * fit.offset[3]:+.0f} ms late" if with_clock else ""
    return f"points belong {', '.join(turns)} in the image{clock}"


def _explanation(offset: Float) -> str:
    """Return an offset (4,) that fits about equally as a clause."""
    turns = [
        f"{abs(turn):.1f} deg {directions[int(turn < 0)]}"
        for turn, directions in zip(offset, _DIRECTIONS, strict=False)
    ]
    return f"{', '.join(turns)} and images {1e3 * offset[3]:+.0f} ms late"


def _check_clock(camera: Camera, fit: Fit, num_images: int) -> Finding:
    """Report the difference between the clocks of camera and lidar."""
    late_s, error_s = float(fit.offset[3]), float(fit.error[3])
    text = (
        f"the images were exposed {abs(late_s) * 1e3:.0f} ± {max(error_s * 1e3, 1):.0f} ms "
        f"{'after' if late_s > 0 else 'before'} their stamps (best fit of {num_images} images)"
    )
    verdict = FINE
    if abs(late_s) > max(_CLOCK_OFF_S, 2 * error_s):
        verdict = WRONG if abs(late_s) - 2 * error_s > _CLOCK_WRONG_S else SUSPICIOUS
    remedy = f"add {late_s:+.3f} s to the stamps of {camera.name}"
    values = {"late_s": late_s, "error_s": error_s}
    return Finding(f"{camera.name}: clock", verdict, text, remedy, values)
