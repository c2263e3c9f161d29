# SPDX-License-Identifier: MIT
"""Place the static objects along a road: houses, walls, hedges, trees, poles, parked cars."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cache

import numpy as np

from densify.geometry.types import Float
from densify.street.actors import WHEELBASE_M, any_paint, car_mesh
from densify.street.materials import Material
from densify.street.mesh import Mesh, box, boxes, leaves, tube
from densify.street.motion import Poses, Rectangles, on_ground, overlap, upright
from densify.street.terrain import Ground, Road, Spans, strip

FIRST_PARKED = 1000  # instances of parked cars count from here
_PANEL_M = 2.0
_AROUND = np.array([(i, j) for i in (-1, 0, 1) for j in (-1, 0, 1)], float)

Panel = Callable[[float], Mesh]
"""Makes a piece of a fence, wall or hedge of a length in metres."""


class Scenery:
    """Collector of static objects, as one mesh and as footprints that traffic must not touch."""

    def __init__(self, ground: Ground, rng: np.random.Generator) -> None:
        self.ground = ground
        self.rng = rng
        self.meshes: list[Mesh] = []
        self.footprints: list[Rectangles] = []
        self._num_parked = 0

    def put(self, mesh: Mesh, xy: Float, heading: float = 0.0, solid: Mesh | None = None) -> None:
        """Place a mesh on the ground; ``solid`` or all of it is tested for collisions."""
        z = float(self.ground.terrain.height(xy)) + self.ground.kerb_m
        self._stand(mesh, upright((*xy, z), heading), solid or mesh)

    def _stand(self, mesh: Mesh, pose: Poses, solid: Mesh) -> None:
        self.meshes.append(mesh.posed(pose.matrix()))
        self.footprints.append(Rectangles.of(solid, pose))

    def is_free(self, mesh: Mesh, xy: Float, heading: float, kerb_gap_m: float) -> bool:
        """Return True if the mesh is clear of the carriageway and of all other objects."""
        place = Rectangles.of(mesh, upright((*xy, 0.0), heading), 0.3)
        if self.footprints:
            self.footprints = [Rectangles.joined(self.footprints)]
            if overlap(self.footprints[0], place).any():
                return False
        (x, y), half = place.forward[0], place.half_m[0]
        around = place.centre + _AROUND * half @ [(x, y), (-y, x)]
        return float(self.ground.distance(around).min()) >= kerb_gap_m

    def put_if_free(
        self, mesh: Mesh, xy: Float, heading: float, kerb_gap_m: float, solid: Mesh | None = None
    ) -> None:
        """Place the mesh if its position is free, else leave it out."""
        if self.is_free(solid or mesh, xy, heading, kerb_gap_m):
            self.put(mesh, xy, heading, solid)

    def park(self, xy: Float, forward: Float) -> None:
        """Place a parked car, tilted with the slope like a driving car."""
        mesh = car_mesh(any_paint(self.rng), self.rng).of_instance(FIRST_PARKED + self._num_parked)
        self._num_parked += 1
        half = forward * WHEELBASE_M["car"] / 2
        pose = on_ground(self.ground.terrain, (xy - half)[None], (xy + half)[None], np.zeros(1))
        self._stand(mesh, pose, mesh)

    def row(self, panel: Panel, start: Float, end: Float, kerb_gap_m: float) -> None:
        """Put a fence, wall or hedge from start to end, panel by panel, each at its own height."""
        length = float(np.linalg.norm(end - start))
        count = max(1, round(length / _PANEL_M))
        heading = float(np.arctan2(*(end - start)[::-1]))
        middles = start + (end - start) * (np.arange(count)[:, None] + 0.5) / count
        for middle in middles[self.ground.distance(middles) > kerb_gap_m]:
            self.put(panel(length / count), middle, heading)


def house(rng: np.random.Generator, width_m: float, depth_m: float) -> Mesh:
    """Return a house with its front along x, facing -y: walls, windows, door and gable roof."""
    storeys = int(rng.integers(2, 4))
    height = 2.8 * storeys + 0.4
    wall = Material.BRICK if rng.random() < 0.55 else Material.PLASTER
    shade = rng.uniform(0.8, 1.15, 3) if wall == Material.PLASTER else rng.uniform(0.85, 1.1, 3)
    tint = (float(shade[0]), float(shade[1]), float(shade[2]))
    w, d = width_m / 2, depth_m / 2
    parts = [box((-w, -d, -1.5), (w, d, height), wall, tint)]
    ridge = height + rng.uniform(0.3, 0.45) * depth_m
    eaves, o = height - 0.1, 0.4
    front = np.array([(-w - o, -d - o, eaves), (w + o, -d - o, eaves), (w + o, 0, ridge),
                      (-w - o, 0, ridge)])  # fmt: skip
    parts.append(Mesh.quads(np.array([front, front * (-1, -1, 1)]), Material.ROOF, tint))
    gable = np.array([[(s, -d, height), (s, d, height), (s, 0, ridge - 0.1), (s, 0, ridge - 0.1)]
                      for s in (-w, w)])  # fmt: skip
    parts.append(Mesh.quads(gable, wall, tint))
    parts += _windows(w, d, storeys)
    parts.append(box((-0.55, -d - 0.06, -0.3), (0.55, -d, 2.15), Material.WOOD, tint))
    parts.append(box((-0.9, -d - 1.0, -0.3), (0.9, -d, 0.12), Material.CONCRETE))
    chimney = float(rng.uniform(-0.6, 0.6)) * w
    parts.append(box((chimney - 0.35, 0.3, height), (chimney + 0.35, 1.0, ridge + 0.7),
                     Material.BRICK))  # fmt: skip
    return Mesh.join(parts)


def _windows(w: float, d: float, storeys: int) -> list[Mesh]:
    frames, panes = [], []
    for storey in range(storeys):
        z = 0.9 + 2.8 * storey
        for x in np.arange(-w + 1.6, w - 1.2, 2.6):
            if storey == 0 and abs(x) < 1.4:
                continue
            frames.append(((x - 0.65, -d - 0.05, z - 0.08), (x + 0.65, -d + 0.02, z + 1.43)))
            panes += [((x + half, -d - 0.06, z), (x + half + 0.52, -d, z + 1.35))
                      for half in (-0.55, 0.03)]  # fmt: skip
        panes += [((s * w - 0.04, y - 0.5, z), (s * w + 0.04, y + 0.5, z + 1.35))
                  for y in np.arange(-d + 2.0, d - 1.5, 3.4) for s in (-1, 1)]  # fmt: skip
    return [boxes(frames, Material.CONCRETE, (1.3, 1.3, 1.3)), boxes(panes, Material.PANE)]


def tree(rng: np.random.Generator) -> tuple[Mesh, Mesh]:
    """Return the mesh of a tree, and the mesh of its trunk."""
    height, spread = rng.uniform(5.5, 9.0), rng.uniform(1.5, 2.5)
    crown = max(2.3, 0.34 * height)
    thick = 0.02 * height + 0.03
    top = (rng.uniform(-0.3, 0.3), rng.uniform(-0.3, 0.3), height * 0.75)
    trunk = tube((0, 0, -0.3), top, (thick, thick * 0.45), Material.BARK)
    parts = [trunk]
    for _ in range(5):
        angle, z = rng.uniform(0, 2 * np.pi), rng.uniform(crown, height * 0.7)
        reach = spread * rng.uniform(0.4, 0.75)
        tip = (reach * np.cos(angle), reach * np.sin(angle), z + reach * 0.8)
        parts.append(tube((top[0] * z / top[2], top[1] * z / top[2], z), tip, (0.06, 0.02),
                          Material.BARK, num_sides=5))  # fmt: skip
    count = int(420 * spread)
    away = rng.normal(size=(count, 3))
    away /= np.linalg.norm(away, axis=1, keepdims=True)
    away *= rng.uniform(0.45, 1.0, (count, 1)) ** 0.5
    middle = [top[0], top[1], (crown + height) / 2 + 0.4]
    lumps = 1 + 0.18 * np.sin(4 * away[:, :1] + rng.uniform(0, 6)) * np.cos(5 * away[:, 1:2])
    centres = middle + away * lumps * [spread, spread, (height - crown) / 2 + 0.3]
    green = (rng.uniform(0.8, 1.3), rng.uniform(0.8, 1.15), rng.uniform(0.7, 1.1))
    parts.append(leaves(centres, 0.36, rng, green))
    foot = tube((0, 0, -0.3), (0, 0, 1.0), max(thick, 0.2), Material.BARK)
    return Mesh.join(parts), foot


def hedge(rng: np.random.Generator, height_m: float) -> Panel:
    """Return a function that makes hedges of a given length."""

    def panel(length_m: float) -> Mesh:
        half = np.array([length_m / 2, 0.35, height_m / 2])
        centres = rng.uniform(-1, 1, (int(75 * length_m * height_m), 3))
        # dense leaves outside, a few twigs inside
        face = rng.integers(0, 3, len(centres))
        push = rng.random(len(centres)) < 0.75
        side = np.sign(centres[np.arange(len(centres)), face])
        centres[push, face[push]] = side[push] * rng.uniform(0.8, 1.0, push.sum())
        foliage = leaves(centres * half + [0, 0, height_m / 2], 0.24, rng, (0.8, 0.9, 0.8))
        stems = [((x - 0.02, -0.02, -0.3), (x + 0.02, 0.02, height_m * 0.7))
                 for x in np.arange(-half[0] + 0.3, half[0], 0.6)]  # fmt: skip
        return Mesh.join([foliage, boxes(stems, Material.BARK)])

    return panel


def wall(height_m: float, material: Material) -> Panel:
    """Return a function that makes walls of a given length."""

    @cache
    def panel(length_m: float) -> Mesh:
        half = length_m / 2 + 0.02
        top = box((-half, -0.16, height_m), (half, 0.16, height_m + 0.07), Material.CONCRETE)
        return Mesh.join([box((-half, -0.12, -0.5), (half, 0.12, height_m), material), top])

    return panel


def picket_fence(height_m: float, tint: tuple[float, float, float]) -> Panel:
    """Return a function that makes fences of a given length."""

    @cache
    def panel(length_m: float) -> Mesh:
        half = length_m / 2
        rails = [((-half, -0.02, z), (half, 0.02, z + 0.08))
                 for z in (0.25 * height_m, 0.75 * height_m)]  # fmt: skip
        pickets = [((x, -0.045, 0.05), (x + 0.09, -0.02, height_m))
                   for x in np.arange(-half, half, 0.17)]  # fmt: skip
        post = ((-half, -0.06, -0.4), (-half + 0.11, 0.05, height_m + 0.1))
        return boxes([*rails, *pickets, post], Material.WOOD, tint)

    return panel


@cache
def lamp_post() -> Mesh:
    """Return a lamp post whose arm reaches out along -y."""
    pole = tube((0, 0, -0.3), (0, 0, 7.0), (0.09, 0.05), Material.METAL)
    arm = tube((0, 0, 6.9), (0, -1.6, 7.2), 0.04, Material.METAL)
    return Mesh.join([pole, arm, box((-0.12, -2.1, 7.12), (0.12, -1.5, 7.24), Material.METAL)])


def sign_post(rng: np.random.Generator) -> Mesh:
    """Return a sign post that faces -x."""
    tint = [(0.25, 0.4, 1.0), (1.0, 0.25, 0.2), (1.0, 0.9, 0.3)][int(rng.integers(3))]
    pole = tube((0, 0, -0.3), (0, 0, 2.9), 0.035, Material.METAL)
    return Mesh.join([pole, box((-0.06, -0.32, 2.2), (-0.04, 0.32, 2.84), Material.PAINT, tint)])


@cache
def litter_bin() -> Mesh:
    """Return a litter bin."""
    return tube((0, 0, 0.0), (0, 0, 0.9), (0.22, 0.25), Material.METAL, (0.45, 0.6, 0.45), 10)


@dataclass(frozen=True)
class Side:
    """One side (+1 left, -1 right) of a road between two stations (arc lengths)."""

    road: Road
    side: int
    begin_m: float
    end_m: float

    def at(self, station_m: float, beyond_kerb_m: float) -> Float:
        """Return the (2,) point ``beyond_kerb_m`` outside the kerb, abreast of the station."""
        s = np.array([station_m])
        edge = self.road.left_m if self.side > 0 else self.road.right_m
        normal = self.road.curve.normal(s)[0] * self.side
        point: Float = self.road.curve(s)[0] + normal * (edge + beyond_kerb_m)
        return point

    def heading(self, station_m: float) -> float:
        """Return the heading with which the +y axis of a mesh points away from the road."""
        return float(np.arctan2(*-self.forward(station_m)[::-1]))

    def forward(self, station_m: float) -> Float:
        """Return the (2,) direction of the traffic on this side. Traffic keeps to the right."""
        tangent: Float = self.road.curve.tangent(np.array([station_m]))[0] * -self.side
        return tangent


def line_with_plots(scenery: Scenery, side: Side) -> None:
    """Place houses behind front gardens, each enclosed by a hedge, a wall or a fence."""
    rng, pavement_m = scenery.rng, scenery.ground.pavement_m
    station = side.begin_m
    while station < side.end_m - 8:
        width = rng.uniform(11.0, 17.0)
        middle = station + width / 2
        heading = side.heading(middle)
        garden = rng.uniform(3.0, 6.5)
        depth = rng.uniform(8.0, 10.5)
        boundary = pavement_m + 0.4
        home = house(rng, width - rng.uniform(2.5, 4.5), depth)
        place = side.at(middle, boundary + garden + depth / 2)
        built = scenery.is_free(home, place, heading, pavement_m + 1.5)
        if built:
            scenery.put(home, place, heading)
        if rng.random() < (0.45 if built else 1.0):
            shoot, foot = tree(rng)
            at = side.at(station + rng.uniform(2.0, width - 2.0), boundary + rng.uniform(1.2, 2.6))
            scenery.put_if_free(shoot, at, 0.0, pavement_m, foot)
        _close_off(scenery, side, station, station + width, boundary, gate=built)
        station += width


def _close_off(
    scenery: Scenery, side: Side, begin: float, end: float, beyond_m: float, gate: bool
) -> None:
    rng = scenery.rng
    kind = int(rng.integers(5))
    light = float(rng.uniform(0.8, 1.9))
    panel: Panel = [
        hedge(rng, float(rng.uniform(0.9, 1.7))),
        hedge(rng, float(rng.uniform(0.9, 1.3))),
        wall(float(rng.uniform(0.6, 1.6)), Material.BRICK),
        picket_fence(float(rng.uniform(0.9, 1.3)), (light, light, light)),
        wall(float(rng.uniform(0.5, 1.1)), Material.CONCRETE),
    ][kind]
    middle = (begin + end) / 2
    spans = [(begin, middle - 1.0), (middle + 1.0, end)] if gate else [(begin, end)]
    for a, b in spans:
        scenery.row(panel, side.at(a, beyond_m), side.at(b, beyond_m), beyond_m - 0.6)


def furnish(scenery: Scenery, side: Side, spacing_m: float, trees: bool) -> None:
    """Place lamp posts, trees, signs and bins along the kerb."""
    rng = scenery.rng
    for station in np.arange(side.begin_m + rng.uniform(2, 8), side.end_m, spacing_m):
        heading = side.heading(station)
        scenery.put_if_free(lamp_post(), side.at(station, 0.55), heading, 0.2)
        if trees:
            for ahead in (0.33, 0.66):
                if rng.random() < 0.5:
                    shoot, foot = tree(rng)
                    at = side.at(station + ahead * spacing_m, 0.75)
                    scenery.put_if_free(shoot, at, 0.0, 0.2, foot)
        if rng.random() < 0.35:
            turned = heading + (np.pi if side.side > 0 else 0.0)
            scenery.put_if_free(sign_post(rng), side.at(station + 4.0, 0.5), turned, 0.1)
        if rng.random() < 0.25:
            scenery.put_if_free(litter_bin(), side.at(station + 1.5, 0.5), heading, 0.2)


def park_cars(scenery: Scenery, side: Side, share: float, keep_free: Spans) -> None:
    """Park cars along the kerb, in a share of the parking spaces."""
    rng = scenery.rng
    station = side.begin_m + 4.0
    while station < side.end_m - 4.0:
        taken = rng.random() < share
        at = side.at(station, -1.15 + rng.uniform(-0.08, 0.08))
        free = not any(a - 3.0 < station < b + 3.0 for a, b in keep_free)
        on_edge = float(scenery.ground.distance(at[None])[0])
        if taken and free and on_edge > -1.6:  # not in the mouth of a side road
            scenery.park(at, side.forward(station))
        station += rng.uniform(5.4, 6.6)


def mark_lanes(
    ground: Ground, road: Road, dashed: Sequence[float], solid: Sequence[float], spans: Spans
) -> Mesh:
    """Paint lines at given offsets to the left of the centreline, only within the spans."""
    dashes = [(s, s + 3.0) for a, b in spans for s in np.arange(a, b - 3.0, 9.0)]
    parts = [strip(ground, road.curve, offset, 0.12, dashes) for offset in dashed]
    parts += [strip(ground, road.curve, offset, 0.12, spans) for offset in solid]
    return Mesh.join(parts)
