# SPDX-License-Identifier: MIT
"""Compute the result of one method for a key: visibility, projection, fill, prior, scores."""

from __future__ import annotations

import copy
import logging
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from densify.config import Config
from densify.config.errors import InputError
from densify.depth.confidence import (
    expected_outliers,
    reliability,
    with_max_outliers,
    without_confirmation,
    without_times,
)
from densify.depth.exposure import Shot
from densify.depth.prior import MAX_WRONG, complete
from densify.depth.views import HeldOut, SeenCloud, Views, with_ages
from densify.free_space.range_image import RangeImage
from densify.geometry.types import Bool, Cloud, DepthMap, Float32, Prior, Result, Stretch
from densify.pipeline.process import Watch
from densify.pipeline.recording import FarSurfaces, Moment
from densify.readers.prior_files import PriorFiles
from densify.registration.deskew import find_compensated
from densify.scores.metrics import depth_scores, ghost_scores, image_density, scores_by_motion

_log = logging.getLogger("densify")


class Method(NamedTuple):
    """The stages that a method uses."""

    all_sweeps: bool  # true if all sweeps of the window are used, else the key sweep alone
    # Name of the scene-flow engine (``flow.engine``), "" for the configured engine, None for rigid
    # accumulation
    engine: str | None
    # True if occluded and unsupported points are rejected, else each pixel shows its nearest point
    visible: bool
    far: bool  # true if static surfaces beyond the window are added (``accumulate.far_m``)


METHODS = {
    "none": Method(False, None, False, False),
    "icp": Method(True, None, False, False),
    "icp-far": Method(True, None, False, True),
    "icp-visible": Method(True, None, True, True),
    "flow-plain": Method(True, "", False, False),
    "paper": Method(True, "paper", True, True),
    "flow": Method(True, "", True, True),
}
"""Methods by name, in this order: single sweep; rigid accumulation of the window; the same with the
far range; the same with far range and visibility; scene flow without visibility; the published
scene flow; our scene flow."""

USUAL = ("none", "icp", "flow")
"""The methods of `run`, and those that `compare` shows by default."""


def methods_of_run(method: str, settings: Config) -> tuple[str, ...]:
    """Return the method of `run`, preceded by its simpler baselines if results are scored."""
    if method not in USUAL:
        raise InputError(f"method {method}: expected one of {', '.join(USUAL)}")
    return USUAL[: USUAL.index(method) + 1] if settings.is_scored else (method,)


def looks_around(methods: Sequence[str]) -> bool:
    """Return True if one of the named methods searches motion around the window (scene flow)."""
    return any(METHODS[name].engine is not None for name in methods if name in METHODS)


class KeyScene(NamedTuple):
    """The inputs that all methods of a key share."""

    settings: Config  # all settings
    key: int  # frame number of the key sweep
    stretch: Stretch  # registered sweeps of the key's window
    # Static surfaces beyond the window; None if unknown or not requested
    far_surfaces: FarSurfaces | None
    key_image: RangeImage  # range image of the key sweep
    views: Views  # viewpoints of the depth maps
    images: Mapping[str, NDArray[np.uint8]]  # map name -> (H,W,3) RGB image that colours the cloud
    # Map name -> ground-truth depth (H,W) in metres and mask (H,W) of moving pixels
    truth: Mapping[str, tuple[Float32, Bool]]
    # The key sweep as ground truth for maps made without it; None without scores
    held_out: HeldOut | None
    watch: Watch  # measures the stages


def result_of_method(
    scene: KeyScene, moments: dict[str, Moment], name: str, filled: bool
) -> Result:
    """Return the result of the method ``name``, without its baselines.

    Args:
        moments: Method -> points at the key's time. This method's entry is removed, to save memory.
        filled: Fill holes of the maps by interpolation.
    """
    method, output = METHODS[name], scene.settings.output
    views, watch, stretch = scene.views, scene.watch, scene.stretch
    visible = method.visible and scene.settings.project.visibility

    far = _see_far(scene, method)
    cloud, flow, tracks = moments.pop(name)
    seen = _see_window(scene, cloud, visible).with_far_points(far)
    cloud = seen.cloud
    held_out = None
    if scene.held_out is not None:
        with watch.stage("held out"):
            held_out = scene.held_out.scores(seen, visible)

    with watch.stage("project"):
        movers = {}
        if output.movers == "separate":
            movers = views.movers(cloud, visible, seen.bodies, scene.images)
        if output.movers != "keep":
            static = cloud.select(~cloud.moving & ~cloud.far)
            seen = views.see(static).with_far_points(far)
        depth_maps = _make_maps(scene, seen, method, visible, filled)
    cloud = seen.cloud
    if scene.images:
        with watch.stage("colour"):
            cloud = views.with_colours(seen, depth_maps, scene.images)
    if visible:
        cloud = views.with_confidence(seen, cloud, depth_maps)
    with watch.stage("score"):
        metrics = _score(scene, cloud, depth_maps, visible, held_out)
    return Result(
        method=name,
        key=scene.key,
        frames=stretch.frames if method.all_sweeps else (scene.key,),
        cloud=cloud,
        depth=depth_maps,
        metrics=metrics,
        flow=flow,
        tracks=tracks,
        movers=movers,
        optical_flow=views.optical_flow(cloud, depth_maps) if output.optical_flow else {},
        rejected=views.rejection_reasons(seen, depth_maps) if output.rejected else {},
        images=scene.images,
        stamp_ns=stretch[scene.key].sweep.stamp_ns,
        views=views.cameras(),
        truth_m={map_name: true_m for map_name, (true_m, _) in scene.truth.items()},
        T_key_lidar={frame: stretch.T_target_source(scene.key, frame) for frame in stretch.frames},
        far_frames=() if far is None else tuple(np.unique(far.cloud.frame).tolist()),
        far_left_out=scene.far_surfaces.world.left_out if far and scene.far_surfaces else (),
    )


def see(scene: KeyScene, name: str, cloud: Cloud) -> SeenCloud:
    """Return the points of the method ``name``, accumulated and far, as the cameras see them."""
    visible = METHODS[name].visible and scene.settings.project.visibility
    return _see_window(scene, cloud, visible).with_far_points(_see_far(scene, METHODS[name]))


def _see_window(scene: KeyScene, cloud: Cloud, visible: bool) -> SeenCloud:
    """Return the accumulated points as the cameras see them, with the bodies of moving objects."""
    with scene.watch.stage("project"):
        seen = scene.views.see(cloud)
        return seen._replace(bodies=scene.views.find_bodies(cloud)) if visible else seen


def _see_far(scene: KeyScene, method: Method) -> SeenCloud | None:
    """Return the static surfaces beyond the window as the cameras see them; None if not used."""
    if not method.far or scene.far_surfaces is None:
        return None
    with scene.watch.stage("far"):
        return scene.views.see_far(*scene.far_surfaces, scene.stretch, static_only=method.visible)


def _make_maps(
    scene: KeyScene, seen: SeenCloud, method: Method, visible: bool, filled: bool
) -> dict[str, DepthMap]:
    """Return the depth maps of the points with ages, limited to ``project.max_outliers``."""
    stretch, views = scene.stretch, scene.views
    stamps_ns = {registered.frame: registered.sweep.stamp_ns for registered in stretch.sweeps}
    if method.far and scene.far_surfaces is not None:
        surfaces = scene.far_surfaces.world
        stamps_ns |= zip(surfaces.frames, surfaces.stamp_ns.tolist(), strict=True)
    is_alone = len(stretch.sweeps) == 1
    untimed_share, period_s = (0.0, 0.0) if is_alone or not visible else _find_untimed(scene)

    depth_maps = dict[str, DepthMap]()
    for name in scene.watch.each("project", seen.in_view):
        exposure = views.exposures[name]
        of_one_map = seen._replace(in_view={name: seen.in_view[name]})
        depth_map = views.depth_maps(of_one_map, visible, filled)[name]
        if visible and is_alone:
            depth_map = without_confirmation(depth_map)
        elif untimed_share:
            # Without a time, a point is off by up to the motion in half a period. Along the
            # camera's z axis that is component 5 of the twist.
            forward_m_s = float(exposure.twist[5])
            shift_m = 0.5 * period_s * abs(forward_m_s)
            depth_map = without_times(depth_map, shift_m, exposure.camera, untimed_share)
        depth_map = with_max_outliers(depth_map, scene.settings.project.max_outliers)
        depth_maps[name] = with_ages(depth_map, stamps_ns, scene.key, exposure.late_s)
    return depth_maps


def _find_untimed(scene: KeyScene) -> tuple[float, float]:
    """Return the share of the sweeps that deskewing moves without point times, and the period."""
    sweeps = [registered.sweep for registered in scene.stretch.sweeps]
    period_s = float(np.median(np.diff([sweep.stamp_ns for sweep in sweeps]))) * 1e-9
    share = float(np.mean([sweep.offset_ns is None for sweep in sweeps]))
    key_sweep = scene.stretch[scene.key]
    # Sweeps already compensated for motion need no point times.
    is_compensated = key_sweep.sweep.offset_ns is None and (
        find_compensated(key_sweep.sweep, key_sweep.twist, period_s) is not None
    )
    return (share if scene.settings.register.deskew and not is_compensated else 0.0), period_s


def _score(
    scene: KeyScene,
    cloud: Cloud,
    depth_maps: Mapping[str, DepthMap],
    visible: bool,
    held_out: dict[str, Any] | None,
) -> dict[str, Any]:
    """Return all scores of a method, of which ``held_out`` are given and depth needs truth."""
    metrics: dict[str, Any] = {
        "num_points": len(cloud),
        "num_moving": int(cloud.moving.sum()),
        "density": {
            name: {"measured": image_density(maps.depth_m), "filled": image_density(maps.filled_m)}
            for name, maps in depth_maps.items()
        },
        "ghosts": ghost_scores(cloud, scene.key_image, scene.key),
    }
    if scene.truth:
        cameras = {name: scene.views.exposures[name].camera for name in depth_maps}
        metrics["depth"] = {
            name: depth_scores(depth_maps[name], *true, cameras[name])
            for name, true in scene.truth.items()
        }
        metrics["reliability"] = {
            name: reliability(depth_maps[name], true_m, cameras[name])
            for name, (true_m, _) in scene.truth.items()
        }
    if visible:
        metrics["expected_outliers"] = {
            name: expected_outliers(depth_map) for name, depth_map in depth_maps.items()
        }
    metrics["measure"] = {name: depth_map.measure for name, depth_map in depth_maps.items()}
    metrics["held_out"] = held_out
    if scene.settings.output.rejected:
        metrics["rejected"] = {name: depth_map.counts() for name, depth_map in depth_maps.items()}
    return metrics


def complete_with_prior(
    scene: KeyScene, result: Result, files: PriorFiles, shots: Mapping[str, Shot]
) -> Result:
    """Return the result with maps that depth images complete (``full``), and their scores.

    A prior that does not fit the measured depth is not used, and a warning is logged. ``shots`` are
    by map name. Raise InputError if ``files`` has no depth image for any map of the key.
    """
    full = {}
    metrics = copy.deepcopy(dict(result.metrics))
    for name, prior in _read_priors(files, shots, result.key).items():
        completed = complete(result.depth[name], prior, scene.settings.prior.kind)
        full[name] = completed
        if not completed.fit.used:
            _log.warning(
                "key %d: the prior %s is not used, depth_full is as depth_filled: after the best "
                "fit %.0f %% of the measured pixels are off by more than 25 %%, expected at most "
                "%.0f %%",
                result.key,
                completed.source,
                100 * completed.fit.wrong,
                100 * MAX_WRONG,
            )
        prior_alone_m = np.where(completed.from_prior, completed.depth_m, np.float32(0))
        for product, depth_m in (("full", completed.depth_m), ("prior", prior_alone_m)):
            metrics["density"][name][product] = image_density(depth_m)
            if name in scene.truth:
                metrics["depth"][name][product] = scores_by_motion(
                    depth_m, *scene.truth[name], shots[name].camera
                )
    return replace(result, full=full, metrics=metrics)


def _read_priors(files: PriorFiles, shots: Mapping[str, Shot], key: int) -> dict[str, Prior]:
    """Return map name -> prior, read by image number, or by key if the map shows no image."""
    priors = {}
    lacking = []  # texts for the maps without a prior
    for name, shot in shots.items():
        number = key if shot.number is None else shot.number
        prior = files.prior(shot.camera, number)
        if prior is not None:
            priors[name] = prior
        else:
            lacking.append(
                f"{shot.camera.name} {number} ({files.describe_available(shot.camera.name)})"
            )
    if lacking and not priors:
        raise InputError(f"prior {files.place}: key {key}: no depth image {', '.join(lacking)}")
    if lacking:
        _log.warning("key %d: no depth_full: no prior %s", key, ", ".join(lacking))
    return priors
