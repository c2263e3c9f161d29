# SPDX-License-Identifier: MIT
"""Draw how moving objects are found and closed, on the built-in street: for docs/how-it-works.md.

`docs/make_pictures.py` calls this.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from numpy.typing import NDArray
from scipy.spatial import ConvexHull

from densify.config import resolve
from densify.config.cache import Cache
from densify.depth.exposure import Exposure, key_shots, load_images
from densify.depth.rays import MovingBody
from densify.flow.engines import Scene
from densify.free_space.ground import ground
from densify.geometry import poses
from densify.geometry.types import Cloud, DepthMap, ObjectTrack, Stretch, Sweep
from densify.pipeline.key_result import see
from densify.pipeline.process import Watch
from densify.pipeline.recording import Recording
from densify.pipeline.run import scene_of
from densify.readers import open_sequence

KEY, CAMERA, CAR, PEDESTRIAN = 120, "image_02", 0, 7  # of the street; numbers of its objects
DARK, LIGHT, DIM = "#181a20", "0.95", "0.45"
ENDS, PASSES, MISSING = "#e69f00", "#56b4e9", "#d55e9f"
RAY_S, NUM_BEAMS = 1 / 20830 / 64, 64  # the beams of the street's scanner fire one after another
COLUMN = 941  # of the scanner's rays, across the wind screen of the car
FIRST_M, LAST_M, CELL_M = np.array([-14.0, -11.0]), np.array([42.0, 17.0]), 0.06  # seen from above

Picture = NDArray[np.uint8]


class Explained(NamedTuple):
    """The key of the street, with what the pipeline found."""

    window: Stretch
    cloud: Cloud
    tracks: tuple[ObjectTrack, ...]
    bodies: dict[int, MovingBody]
    seen_through: NDArray[np.float64]  # (N,3) key frame: points that other sweeps saw through
    image: Picture
    exposure: Exposure
    depth: DepthMap


def explained() -> Explained:
    """Densify the key of the street."""
    sequence, settings = open_sequence("street"), resolve(None)
    recording = Recording(sequence, settings, 5, [KEY], Cache(), looks_around=True)
    cloud, _, tracks = recording.moment(KEY, True, "")
    shots = key_shots(sequence, [sequence.cameras[CAMERA]], KEY, settings.project)
    images, window = load_images(sequence, shots), recording.window(KEY)
    scene = scene_of(recording, KEY, shots, images, None, cloud, False, Watch())
    seen = see(scene, "flow", cloud)
    search = Scene(window, ground(window))
    seen_through = np.concatenate([one.points[one.seed] for one in search.obstacles])
    return Explained(
        window,
        cloud,
        tracks,
        dict(seen.bodies),
        poses.transform(poses.inverse(window[KEY].T_world_lidar), seen_through),
        images[CAMERA],
        scene.views.exposures[CAMERA],
        scene.views.depth_maps(seen)[CAMERA],
    )


def axes(size: tuple[float, float], rows: int, columns: int, **grid: Any) -> tuple[Figure, Any]:
    """Return a dark figure of inches with its axes (rows, columns)."""
    figure = Figure(figsize=size, dpi=100, facecolor=DARK, layout="constrained")
    plots = figure.subplots(rows, columns, squeeze=False, gridspec_kw=grid)
    for plot in plots.ravel():
        plot.set_facecolor(DARK)
        plot.tick_params(colors="0.8")
        plot.spines[:].set_color(DIM)
    return figure, plots


def label(plot: Axes, title: str, x: str = "", y: str = "") -> None:
    """Write the title and the labels of a plot."""
    plot.set_title(title, color=LIGHT, fontsize=12)
    plot.set_xlabel(x, color="0.8")
    plot.set_ylabel(y, color="0.8")


def pixels(figure: Figure) -> Picture:
    """Return the (H,W,3) picture of a figure."""
    canvas = FigureCanvasAgg(figure)
    canvas.draw()
    return np.asarray(canvas.buffer_rgba())[..., :3].copy()


class FiredRays(NamedTuple):
    """The rays of the key sweep's scanner by column and beam, with or without a return."""

    row: NDArray[np.int64]  # (C,64) index of the return in the sweep, -1 for no return
    on_car: NDArray[np.bool_]  # (C,64)
    azimuth_deg: NDArray[np.float64]  # (C,)
    elevation_deg: NDArray[np.float64]  # (64,) near the car

    @staticmethod
    def of(sweep: Sweep, cloud: Cloud) -> FiredRays:
        """Find the ray of each return by its firing time."""
        number = np.rint((np.asarray(sweep.offset_ns) * 1e-9 + 0.05) / RAY_S).astype(int)
        column, beam = np.divmod(number, NUM_BEAMS)
        row = np.full((column.max() + 1, NUM_BEAMS), -1)
        row[column, beam] = np.arange(len(sweep))
        own = cloud.row[(cloud.frame == sweep.frame) & (cloud.instance == CAR)]
        on_car = (row >= 0) & np.isin(sweep.row, own)[row]
        x, y, z = sweep.points.T
        azimuth, elevation = (np.degrees(np.arctan2(*a)) for a in ((y, x), (z, np.hypot(x, y))))
        near = np.flatnonzero(np.isin(column, np.flatnonzero(on_car.any(axis=1))))
        by_column = np.polyfit(column[near], azimuth[near], 1)
        elevation_deg = [np.median(elevation[near][beam[near] == b]) for b in range(NUM_BEAMS)]
        azimuth_deg = np.polyval(by_column, np.arange(len(row)))
        return FiredRays(row, on_car, azimuth_deg, np.array(elevation_deg))


def rays_picture(found: Explained) -> Picture:
    """Draw rays that end on a car, pass it, or have no return."""
    sweep = found.window[KEY].sweep
    rays = FiredRays.of(sweep, found.cloud)
    figure, ((side, front),) = axes((13, 4.2), 1, 2)
    touched = np.flatnonzero(rays.on_car.any(axis=1))
    columns = np.arange(touched[0] - 12, touched[-1] + 13)
    u, v = np.meshgrid(rays.azimuth_deg[columns], rays.elevation_deg, indexing="ij")
    missing, ends = rays.row[columns] < 0, rays.on_car[columns]
    for where, colour, name, style in (
        (~missing & ~ends, PASSES, "passes the car", {"s": 3, "marker": "o"}),
        (missing, MISSING, "no return", {"s": 8, "marker": "x", "linewidths": 0.7}),
        (ends, ENDS, "ends on the car", {"s": 5, "marker": "o"}),
    ):
        front.scatter(u[where], v[where], c=colour, label=name, **style)
    front.axvline(rays.azimuth_deg[COLUMN], color="0.9", lw=0.8, ls=":")
    front.set(xlim=rays.azimuth_deg[columns[[-1, 0]]][::-1], ylim=(-15, 1))
    label(front, "the rays towards a car", "azimuth, degrees", "elevation, degrees")
    front.legend(loc="lower left", facecolor=DARK, edgecolor=DIM, labelcolor=LIGHT, framealpha=1)

    points = found.cloud.points[found.cloud.instance == CAR]
    azimuth_deg = np.degrees(np.arctan2(points[:, 1], points[:, 0]))
    slice_ = points[abs(azimuth_deg - rays.azimuth_deg[COLUMN]) < 1]
    side.scatter(np.hypot(*slice_.T[:2]), slice_[:, 2], s=3, c=DIM, linewidths=0)
    for elevation_deg, row, on_car in zip(
        rays.elevation_deg, rays.row[COLUMN], rays.on_car[COLUMN], strict=True
    ):
        slope, range_m = math.tan(math.radians(elevation_deg)), 20.0
        if row >= 0:
            x, y, z = sweep.points[row]
            range_m, slope = math.hypot(x, y), z / math.hypot(x, y)
            side.plot(range_m, z, "o", c=ENDS if on_car else PASSES, ms=4)
        style = {"c": MISSING, "ls": (0, (2, 3))} if row < 0 else {"c": ENDS if on_car else PASSES}
        side.plot([0, range_m], [0, range_m * slope], lw=0.8, **style)
    side.set(xlim=(4.5, 12), ylim=(-2, 0.3))
    title = "the dotted column from the side; grey: the car's points of all sweeps"
    label(side, title, "metres from the scanner", "metres above it")
    return pixels(figure)


def evidence_picture(found: Explained) -> Picture:
    """Draw from above the points that other sweeps saw through, and the confirmed tracks."""
    figure, ((before, after),) = axes((14, 3.9), 1, 2)
    cloud = found.cloud
    shown = ~cloud.far & (cloud.points[:, 2] < 2.5)
    titles = "rigid: points that another sweep saw through", "moved along the confirmed tracks"
    for plot, points, title in zip(
        (before, after), (cloud.rigid_points, cloud.points), titles, strict=True
    ):
        cell = ((points[shown, :2] - FIRST_M) / CELL_M).astype(int)
        size = ((LAST_M - FIRST_M) / CELL_M).astype(int)
        height_m = np.full(size, -np.inf)
        inside = ((cell >= 0) & (cell < size)).all(axis=1)
        np.maximum.at(height_m, tuple(cell[inside].T), points[shown][inside, 2])
        grey = np.where(
            np.isfinite(height_m), 0.25 + 0.4 * np.clip((height_m + 1.9) / 3, 0, 1), 0.1
        )
        extent = (FIRST_M[0], LAST_M[0], FIRST_M[1], LAST_M[1])
        plot.imshow(grey.T, "gray", origin="lower", extent=extent, vmin=0, vmax=1)
        plot.plot(0, 0, "^", c="w", ms=7)
        label(plot, title, "metres ahead", "metres to the left" * (plot is before))
    before.scatter(*found.seen_through.T[:2], s=0.8, c=ENDS, linewidths=0)
    after.scatter(*cloud.points[cloud.moving].T[:2], s=0.5, c=ENDS, linewidths=0)
    for track in found.tracks:
        after.plot(*track.T_key_object[:, :2, 3].T, c="w", lw=1)
        x, y = track.size_m[:2] / 2
        outline = np.array([[x, y, 0], [x, -y, 0], [-x, -y, 0], [-x, y, 0], [x, y, 0]])
        corners = poses.transform(track.T_key_object[track.frames.index(KEY)], outline)
        after.plot(*corners.T[:2], c=PASSES, lw=1.2)
    for plot in (before, after):
        plot.set(xlim=(FIRST_M[0], LAST_M[0]), ylim=(FIRST_M[1], LAST_M[1]))
    return pixels(figure)


def hull_picture(found: Explained, measured: Picture, filled: Picture) -> Picture:
    """Draw hulls with their returns and rays, beside the coloured depth maps (H,W,3)."""
    figure, plots = axes((14, 4.5), 2, 4)
    for instance, panels in zip((CAR, PEDESTRIAN), plots, strict=True):
        body, see = found.bodies[instance], found.exposure.see
        own = found.cloud.instance == instance
        returns = see(found.cloud.points[own], found.cloud.velocity_m_s[own]).uv
        corners = see(body.corners, body.velocity_m_s).uv
        hull = corners[ConvexHull(corners).vertices]
        hull = np.vstack([hull, hull[:1]])
        entries = see(body.entries, body.velocity_m_s).uv
        some = np.random.default_rng(0).permutation(len(entries))[:4000]
        dark = found.image // 3
        for panel, picture in zip(panels, (found.image, dark, measured, filled), strict=True):
            panel.imshow(picture, interpolation="nearest")
            middle, half = (hull.min(axis=0) + hull.max(axis=0)) / 2, np.ptp(hull, axis=0) / 2 + 12
            half_u = max(half[0], 1.95 * half[1])
            panel.set(xlim=middle[0] + [-half_u, half_u], ylim=middle[1] + [half[1], -half[1]])
            panel.set(xticks=[], yticks=[])
        for panel in panels[:2]:
            panel.plot(*hull.T, c="w", lw=1)
        panels[0].scatter(*returns.T, s=1.5, c=ENDS, linewidths=0)
        for ends, colour in ((True, ENDS), (False, PASSES)):
            panels[1].scatter(
                *entries[some[body.ends[some] == ends]].T, s=2.5, c=colour, linewidths=0
            )
    titles = "hull and returns of 11 sweeps", "rays that end (orange), pass (blue)"
    for plot, title in zip(plots[0], (*titles, "measured depth", "filled depth"), strict=True):
        label(plot, title)
    return pixels(figure)
