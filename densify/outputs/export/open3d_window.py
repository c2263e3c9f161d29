# SPDX-License-Identifier: MIT
"""Finished runs in a window of open3d's (https://www.open3d.org, ``densify[open3d]``): the scene,
beside it the images with their depth, and a time line over the sweeps of one key's window, or over
the keys of a drive. Layers that can be switched on and off::

    standing, moving  the accumulated cloud, at the key's moment
    trails            what moves where registration alone puts it; hidden at first
    sweep             the sweep of that time as it was measured
    movers            boxes and paths of moving objects, with their speeds
    cameras           frusta of pinholes
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable, Sequence
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from densify.config.errors import InputError
from densify.geometry.types import Float, ObjectTrack
from densify.outputs.export.finished_run import FinishedRun
from densify.outputs.export.timeline import Shot, SweepShown, Timeline, timelines
from densify.outputs.figure import draw_figure
from densify.outputs.png import Picture
from densify.readers.decoded_files import decode_image
from densify.readers.extras import needed

LAYERS = ("standing", "moving", "trails", "sweep", "movers", "cameras")
PICTURES = ("image", "measured", "filled")
_HIDDEN = ("trails",)
_UNSEEN, _SWEEP = (0.6, 0.6, 0.6), (0.84, 0.37, 0.0)
_BOX, _PATH, _FRUSTUM = (0.0, 0.45, 0.7), (0.34, 0.71, 0.91), (0.1, 0.1, 0.1)
_WIDTH_PX, _HEIGHT_PX = 1440, 810
_PANEL_EM = 40
_POINT_PX, _LINE_PX = 2.0, 2.0
_FRUSTUM_M = 2.0
_EYE_M, _AHEAD_M, _UP = (-16.0, 0.0, 9.0), (14.0, 0.0, 0.0), (0.0, 0.0, 1.0)


def show(runs: Sequence[FinishedRun], begun: Callable[[Viewer], None] | None = None) -> None:
    """Open the window, return when it is closed. All keys of a drive are held in memory.

    begun: called when the window is there. Raises InputError without open3d or a screen, and as
    `timelines`.
    """
    o3d = needed("open3d", "open3d", "Windows with the cloud")
    if not (os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")):
        raise _no_window("neither DISPLAY nor WAYLAND_DISPLAY is set")
    shown = list(timelines(runs))
    application = o3d.visualization.gui.Application.instance
    try:
        application.initialize()
        viewer = Viewer(o3d, shown)
    except RuntimeError as error:
        raise _no_window(str(error)) from None
    if begun is not None:
        begun(viewer)
    application.run()


def _no_window(reason: str) -> InputError:
    return InputError(
        f"open3d cannot open a window here ({reason}): it needs a screen with its drivers; densify "
        f"report makes a page for any browser"
    )


class Viewer:
    """The window with its controls. ``num_steps``: of the time line."""

    def __init__(self, o3d: Any, shown: Sequence[Timeline]) -> None:
        """o3d: the package. shown: one or more."""
        self._o3d, self._gui = o3d, o3d.visualization.gui
        self._steps = [(timeline, sweep) for timeline in shown for sweep in timeline.sweeps]
        self.num_steps = len(self._steps)
        self._shots = {shot.name: shot for shot in shown[0].shots}
        self._key: Timeline | None = None
        names = dict.fromkeys(shot.name for timeline in shown for shot in timeline.shots)
        self._chosen = (next(iter(names), ""), PICTURES[0])
        application = self._gui.Application.instance
        self.window = application.create_window("densify", _WIDTH_PX, _HEIGHT_PX)
        self.layers = _Layers(o3d, self.window)
        self._panel = self._controls(list(names))
        self.window.add_child(self.layers.widget)
        self.window.add_child(self._panel)
        self.window.set_on_layout(self._lay_out)
        keys = (
            at for at, (timeline, sweep) in enumerate(self._steps) if sweep.frame == timeline.key
        )
        self.go_to(next(keys, 0))
        self.layers.look_from_behind()

    def go_to(self, step: int) -> None:
        """Show what there is at that time, 0 to `num_steps` - 1."""
        key, sweep = self._steps[step]
        self._time.int_value = step
        self._said.text = f"key {key.key}, sweep {sweep.frame}"
        if key is not self._key:
            self._key, self._shots = key, {shot.name: shot for shot in key.shots}
            self.layers.show_key(key)
            self.choose(*self._chosen)
        self.layers.show_sweep(key, sweep)
        self.window.post_redraw()

    def choose(self, camera: str, picture: str) -> None:
        """Show one of `PICTURES` of a camera."""
        self._chosen = (camera, picture)
        if camera in self._shots:
            pixels = np.ascontiguousarray(_picture(self._shots[camera], picture))
            self._image.update_image(self._o3d.geometry.Image(pixels))
            self.window.post_redraw()

    def _controls(self, cameras: Sequence[str]) -> Any:
        gui, em = self._gui, self.window.theme.font_size
        panel = gui.Vert(0.5 * em, gui.Margins(em, em, em, em))
        self._said, self._time = gui.Label(""), gui.Slider(gui.Slider.INT)
        self._time.set_limits(0, max(1, self.num_steps - 1))
        self._time.set_on_value_changed(lambda at: self.go_to(min(int(at), self.num_steps - 1)))
        panel.add_child(self._said)
        panel.add_child(self._time)
        for layer in LAYERS:
            box = gui.Checkbox(layer)
            box.checked = layer not in _HIDDEN
            box.set_on_checked(partial(self.layers.switch, layer))
            panel.add_child(box)
        self._image = gui.ImageWidget()
        if cameras:
            panel.add_child(self._choice(cameras, lambda name: (name, self._chosen[1])))
            panel.add_child(self._choice(PICTURES, lambda kind: (self._chosen[0], kind)))
            panel.add_child(self._image)
        return panel

    def _choice(self, names: Iterable[str], chosen: Callable[[str], tuple[str, str]]) -> Any:
        box = self._gui.Combobox()
        for name in names:
            box.add_item(name)
        box.set_on_selection_changed(lambda name, _: self.choose(*chosen(name)))
        return box

    def _lay_out(self, _: Any) -> None:
        """The scene to the left, the panel to the right."""
        whole = self.window.content_rect
        width = min(whole.width // 2, _PANEL_EM * self.window.theme.font_size)
        left = whole.width - width
        self.layers.widget.frame = self._gui.Rect(whole.x, whole.y, left, whole.height)
        self._panel.frame = self._gui.Rect(whole.x + left, whole.y, width, whole.height)


class _Layers:
    """What is in the scene, by layer."""

    def __init__(self, o3d: Any, window: Any) -> None:
        self._o3d, self._window = o3d, window
        self.widget = o3d.visualization.gui.SceneWidget()
        self.widget.scene = o3d.visualization.rendering.Open3DScene(window.renderer)
        self.widget.scene.set_background([1.0, 1.0, 1.0, 1.0])
        self._on = {layer: layer not in _HIDDEN for layer in LAYERS}
        self._names: dict[str, list[str]] = {layer: [] for layer in LAYERS}
        self._texts: list[tuple[Float, str]] = []
        self._labels: list[Any] = []

    def switch(self, layer: str, on: bool) -> None:
        self._on[layer] = on
        for name in self._names[layer]:
            self.widget.scene.show_geometry(name, on)
        self._write_labels()
        self._window.post_redraw()

    def show_key(self, key: Timeline) -> None:
        cloud, moving = key.cloud, key.cloud.moving
        for layer, points, own in (
            ("standing", cloud.points, ~moving),
            ("moving", cloud.points, moving),
            ("trails", cloud.rigid_points, moving),
        ):
            rgb = cloud.rgb[own]
            colours = np.where(rgb.any(axis=1, keepdims=True), rgb / 255, _UNSEEN)
            self._put(key, layer, [self._points(points[own], colours)] if own.any() else [])
        frusta = [self._frustum(shot) for shot in key.shots if shot.is_pinhole]
        self._put(key, "cameras", frusta)

    def show_sweep(self, key: Timeline, sweep: SweepShown) -> None:
        colours = np.broadcast_to(_SWEEP, (len(sweep.points), 3))
        self._put(key, "sweep", [self._points(sweep.points, colours)] if len(colours) else [])
        paths = [self._path(track) for track in key.tracks if len(track.frames) > 1]
        seen = [(t, t.frames.index(sweep.frame)) for t in key.tracks if sweep.frame in t.frames]
        self._put(key, "movers", [*paths, *(self._box(track, at) for track, at in seen)])
        self._texts = [_speed(key.T_world_key, track, at) for track, at in seen]
        self._write_labels()

    def look_from_behind(self) -> None:
        bounds = self.widget.scene.bounding_box
        self.widget.setup_camera(60.0, bounds, bounds.get_center())
        self.widget.look_at(_AHEAD_M, _EYE_M, _UP)

    def _put(self, key: Timeline, layer: str, geometries: Sequence[Any]) -> None:
        """Show this in the place of what the layer had."""
        scene = self.widget.scene
        for name in self._names[layer]:
            scene.remove_geometry(name)
        self._names[layer] = [f"{layer} {number}" for number in range(len(geometries))]
        for name, geometry in zip(self._names[layer], geometries, strict=True):
            scene.add_geometry(name, geometry, self._material(geometry))
            scene.set_geometry_transform(name, key.T_world_key)
            scene.show_geometry(name, self._on[layer])

    def _material(self, geometry: Any) -> Any:
        material = self._o3d.visualization.rendering.MaterialRecord()
        is_lines = isinstance(geometry, self._o3d.geometry.LineSet)
        material.shader = "unlitLine" if is_lines else "defaultUnlit"
        material.line_width = _LINE_PX * self._window.scaling
        material.point_size = _POINT_PX * self._window.scaling
        return material

    def _points(self, points: NDArray[Any], colours: NDArray[Any]) -> Any:
        tensor, made = self._o3d.core.Tensor, self._o3d.t.geometry.PointCloud()
        made.point.positions = tensor(np.ascontiguousarray(points, np.float32))
        made.point.colors = tensor(np.ascontiguousarray(colours, np.float32))
        return made

    def _box(self, track: ObjectTrack, at: int) -> Any:
        T = track.T_key_object[at]
        box = self._o3d.geometry.OrientedBoundingBox(T[:3, 3], T[:3, :3], track.size_m)
        lines = self._o3d.geometry.LineSet.create_from_oriented_bounding_box(box)
        return self._painted(lines, _BOX)

    def _path(self, track: ObjectTrack) -> Any:
        places = track.T_key_object[:, :3, 3]
        lines = self._o3d.geometry.LineSet()
        lines.points = self._o3d.utility.Vector3dVector(places)
        steps = np.arange(len(places) - 1)
        lines.lines = self._o3d.utility.Vector2iVector(np.stack([steps, steps + 1], axis=1))
        return self._painted(lines, _PATH)

    def _frustum(self, shot: Shot) -> Any:
        camera = shot.view.camera
        lines = self._o3d.geometry.LineSet.create_camera_visualization(
            camera.width_px, camera.height_px, camera.K, shot.view.T_cam_key, _FRUSTUM_M
        )
        return self._painted(lines, _FRUSTUM)

    def _painted(self, lines: Any, colour: tuple[float, float, float]) -> Any:
        colours = np.tile(colour, (len(lines.lines), 1))
        lines.colors = self._o3d.utility.Vector3dVector(colours)
        return lines

    def _write_labels(self) -> None:
        for label in self._labels:
            self.widget.remove_3d_label(label)
        texts = self._texts if self._on["movers"] else []
        self._labels = [self.widget.add_3d_label(place, text) for place, text in texts]


def _speed(T_world_key: Float, track: ObjectTrack, at: int) -> tuple[Float, str]:
    """What stands above an object, and where (3,) in the world."""
    place = T_world_key @ track.T_key_object[at] @ [0, 0, track.size_m[2] / 2 + 0.3, 1]
    return place[:3], f"{track.instance}: {np.linalg.norm(track.velocity_m_s[at]):.1f} m/s"


def _picture(shot: Shot, picture: str) -> Picture:
    """(H,W,3) RGB of one of `PICTURES`; depth over the image, with a scale in metres."""
    image = np.zeros((*shot.depth_m.shape, 3), np.uint8)
    if shot.jpeg is not None:
        image = decode_image(shot.jpeg, shot.name)[..., ::-1]
    if picture == "image":
        return image
    return draw_figure(image, {picture: shot.depth_m if picture == "measured" else shot.filled_m})
