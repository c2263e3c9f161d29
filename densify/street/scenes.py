# SPDX-License-Identifier: MIT
"""Build the scenes of scenes.yaml: roads, static objects beside them, traffic that never collides.

Time 0 is frame 0. The actors are around the ego vehicle at the meeting time.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np

from densify.geometry.types import Float
from densify.street import models, motion, read_table
from densify.street.ground import Ground, Road, Side, mark_road
from densify.street.mesh import Material, Mesh
from densify.street.models import WHEELBASE_M, Actor, model, panel, resolve
from densify.street.motion import SPAN_S, Curve, Driving, Lane, Rectangles, Speed, left_of, upright
from densify.street.world import Body, World

_TABLES = read_table("scenes")
_FIRST_PARKED = 1000  # object number of the first parked car
_NUM_SEEDS = 2**31  # number of possible seeds of the random properties of surfaces
_TRIES = 40  # most random draws of an actor that collides
_TOUCH_M = 25.0  # greatest distance of the centres of two objects that touch
_ROAD_END_M = 20.0  # no object is nearer to the end of a road
_CLEAR_M = 0.3  # least distance between static objects
# Widths of the margin around an actor's outline: limbs reach beyond the outline of a trunk.
_ACTOR_MARGIN_M, _LIMBS_MARGIN_M, _EGO_MARGIN_M = 0.1, 0.3, 0.2
_OUTLINE_STEP_S = 0.1
_KERB_RAMP_M = 0.25  # distance over which a pedestrian steps on the kerb
_CONVOY = range(-9, 7)  # numbers of the vehicles of a convoy, 0 at its station
_CONVOY_VARIES = 0.2  # share by which the gaps of a convoy vary


@dataclass(frozen=True)
class Scene:
    """A world and its moving actors."""

    world: World  # all bodies except the ego vehicle
    ground: Ground
    ego: Driving  # motion of the ego vehicle
    actors: tuple[Actor, ...]
    footprints: Rectangles  # rectangles of the static objects that traffic must not touch


def build(preset: str, rng: np.random.Generator) -> Scene:
    """Return a random scene. ``preset`` is a key of `PRESETS`, and ``rng`` is advanced."""
    table, lay_roads = PRESETS[preset]

    # Roads, ground and static objects
    curves, stations = lay_roads(table, rng)
    roads = {name: Road(curves[name], **vars(sides)) for name, sides in vars(table.roads).items()}
    terrain = motion.Terrain.hilly(rng, table.ground.max_slope, getattr(table.ground, "scale", 1.0))
    ground = Ground(terrain, tuple(roads.values()), table.ground.kerb_m, table.ground.pavement_m)
    scenery = Scenery(ground, rng)
    stations["end"] = roads["main"].curve.length_m - _ROAD_END_M
    if hasattr(table, "plots"):
        _line_with_plots(scenery, table, roads, stations)
    else:
        _line_motorway(scenery, roads["main"], stations["end"])
    meshes = [ground.mesh(table.ground.margin_m, table.ground.cell_m)]
    for row in table.markings:
        spans = resolve(row.spans, stations)
        meshes.append(mark_road(ground, roads[row.road], row, spans))

    # The ego vehicle; "here" is its station on the main road at the meeting time.
    ego_lane = getattr(table.lanes, table.ego.lane)
    lane = Lane(curves[ego_lane.road], ego_lane.offset_m)
    ego = Driving(
        lane.curve, Speed(*table.ego.knots), lane.at(table.ego.station), 0.0, terrain,
        _TABLES.ego_wheelbase_m,
    )  # fmt: skip
    if "here" not in stations:
        ego_m = ego.station(np.array([_TABLES.meeting_s]))[0]
        stations["here"] = float(np.interp(ego_m, lane.curve.knots_m, curves["main"].knots_m))

    traffic = Traffic(ego, scenery, vars(table.lanes), curves)
    if preset != "static":
        for row in table.traffic:
            traffic.add_row(row, stations)
    static = Body(Mesh.join([*meshes, *scenery.meshes]), motion.Still())
    bodies = [static, *(body for actor in traffic.actors for body in actor.bodies)]
    footprints = Rectangles.joined(scenery.footprints)
    world = World(bodies, int(rng.integers(_NUM_SEEDS)))
    return Scene(world, ground, ego, tuple(traffic.actors), footprints)


# Roads: curves by name, and stations by name


def _lay_street(table: Any, rng: np.random.Generator) -> tuple[dict[str, Curve], dict[str, float]]:
    """Return the curves of main road, side road and turning truck by name, and the stations."""
    left, right, wiggle = table.left_bend, table.right_bend, table.wiggle
    left_curvature = 1 / (left.radius_m * _vary(rng, left.vary))
    right_curvature = _vary(rng, right.vary) / right.radius_m
    wiggle_curvature = _vary(rng, wiggle.vary) / wiggle.radius_m
    phase = rng.uniform(0, 2 * np.pi)

    def share_of_bend(ahead: Float, bend: Any) -> Float:
        """Return 1 within a bend and 0 outside, with a ramp at its ends."""
        ramps = np.minimum(ahead - bend.begin_m, bend.end_m - ahead) / table.ramp_m
        return np.clip(ramps, 0, 1)

    def curvature(station: Float) -> Float:
        ahead = station - table.start_m  # distance ahead of the ego vehicle's start
        left_share = share_of_bend(ahead, left)
        right_share = share_of_bend(ahead, right)
        bends = left_curvature * left_share - right_curvature * right_share
        # Before and after both bends the road wiggles.
        outside = np.maximum(wiggle.before_m - ahead, ahead - wiggle.after_m) / wiggle.ramp_m
        amplitude = np.clip(outside, 0, 1) * wiggle_curvature
        return bends + amplitude * np.sin(station / wiggle.wave_m + phase)

    main = Curve.bending(table.length_m, curvature, table.start_m)
    mouth = np.array([table.stations.mouth])
    along_m = np.arange(0.0, table.side_road_m + motion.STEP_M, motion.STEP_M)
    side = Curve(main(mouth)[0] + main.normal(mouth)[0] * along_m[:, None])
    turn, turn_m = _turn(table, main, side)
    return {"main": main, "side": side, "turn": turn}, {**vars(table.stations), "turn": turn_m}


def _turn(table: Any, main: Curve, side: Curve) -> tuple[Curve, float]:
    """Return the path from the oncoming lane into the side road, and the station of its turn."""
    shape = table.turn
    oncoming = Lane(main, table.lanes.oncoming.offset_m, forward=False).curve
    xy = oncoming(np.arange(0.0, oncoming.length_m, motion.STEP_M))
    mouth = side(np.zeros(1))[0]
    side_direction = side.tangent(np.zeros(1))[0]
    ego_direction = -left_of(side_direction)
    # The path follows the oncoming lane up to the mouth of the side road, then rounds a corner.
    is_near = np.abs(xy - mouth).sum(axis=1) < shape.search_m
    straight = xy[is_near & ((xy - mouth) @ ego_direction > shape.straight_to_m)]
    corner = mouth + ego_direction + side_direction * float((straight[-1] - mouth) @ side_direction)
    end = corner + shape.beyond_m * side_direction
    bend = motion.polyline([straight[-1], corner, end], shape.radius_m)
    curve = Curve(np.concatenate([straight[:-1], bend]))
    straight_m, arc_m = shape.beyond_m - shape.radius_m, shape.radius_m * np.pi / 2
    return curve, curve.length_m - straight_m - arc_m


def _lay_crossing(table: Any, _: object) -> tuple[dict[str, Curve], dict[str, float]]:
    """Return the curves of the crossroads (straight roads and turning paths), and the stations."""
    curves = {
        name: Curve(motion.polyline(path.corners, getattr(path, "radius_m", 0.0)))
        for name, path in vars(table.paths).items()
    }
    return curves, dict(vars(table.stations))


def _lay_highway(table: Any, rng: np.random.Generator) -> tuple[dict[str, Curve], dict[str, float]]:
    """Return the main road, whose gentle bends alternate, and the stations, by name."""
    wiggle = table.wiggle
    bend, phase = _vary(rng, wiggle.vary) / wiggle.radius_m, rng.uniform(0, 2 * np.pi)

    def curvature(station: Float) -> Float:
        return bend * np.sin(station / wiggle.wave_m + phase)

    main = Curve.bending(table.length_m, curvature, table.start_m)
    return {"main": main}, dict(vars(table.stations))


def _vary(rng: np.random.Generator, share: float) -> float:
    """Return a random factor of 1 ± ``share``."""
    return float(rng.uniform(1 - share, 1 + share))


# Static objects


class Scenery:
    """Collector of static objects, as one mesh and as footprints that traffic must not touch."""

    def __init__(self, ground: Ground, rng: np.random.Generator) -> None:
        self.ground = ground
        self.rng = rng
        self.meshes: list[Mesh] = []
        self.footprints: list[Rectangles] = []
        self._num_parked = 0

    def put(
        self,
        mesh: Mesh,
        xy: Float,
        heading: float = 0.0,
        solid: Mesh | None = None,
        kerb_gap_m: float | None = None,
    ) -> bool:
        """Place a mesh on the ground at ``xy`` (2,), world, turned by a heading (rad) about z.

        Args:
            solid: Part of the mesh that traffic must not touch, None for the whole mesh.
            kerb_gap_m: Place it only if this part is 0.3 m from all objects and this far from the
                kerb. None places it in any case.

        Returns:
            True if the mesh is placed.
        """
        solid = solid or mesh
        if kerb_gap_m is not None and not self._is_free(solid, xy, heading, kerb_gap_m):
            return False
        z = float(self.ground.terrain.height(xy)) + self.ground.kerb_m
        self._stand(mesh, upright((*xy, z), heading), solid)
        return True

    def _stand(self, mesh: Mesh, pose: motion.Poses, solid: Mesh) -> None:
        """Add a mesh at its pose, and the footprint of its solid part."""
        self.meshes.append(mesh.posed(pose.matrices()[0]))
        self.footprints.append(Rectangles.of(solid, pose))

    def _is_free(self, mesh: Mesh, xy: Float, heading: float, kerb_gap_m: float) -> bool:
        """Return True if a mesh is 0.3 m from all objects, and ``kerb_gap_m`` from the kerb."""
        outline = Rectangles.of(mesh, upright((*xy, 0.0), heading), _CLEAR_M)
        if self.footprints:
            self.footprints = [Rectangles.joined(self.footprints)]
            if motion.overlap(self.footprints[0], outline).any():
                return False
        forward = outline.forward[0]
        # The outline is tested at its centre, its corners and the middles of its sides.
        grid = np.array([(i, j) for i in (-1, 0, 1) for j in (-1, 0, 1)], float)
        tested = outline.centre + grid * outline.half_m[0] @ [forward, left_of(forward)]
        return float(self.ground.distance(tested).min()) >= kerb_gap_m

    def park(self, xy: Float, forward: Float) -> None:
        """Place a random parked car at ``xy`` (2,), world, along the direction ``forward`` (2,)."""
        mesh = models.car_mesh(models.random_paint(self.rng), self.rng)
        mesh = mesh.of_instance(_FIRST_PARKED + self._num_parked)
        self._num_parked += 1
        half = forward * WHEELBASE_M["car"] / 2
        pose = motion.on_ground(
            self.ground.terrain, (xy - half)[None], (xy + half)[None], np.zeros(1)
        )
        self._stand(mesh, pose, mesh)


def _line_with_plots(
    scenery: Scenery, table: Any, roads: Mapping[str, Road], stations: Mapping[str, float]
) -> None:
    """Place houses, then lamps and trees at the kerb, then parked cars, along all plots."""
    sides = [
        Side(roads[row.road], row.side, row.begin, resolve(row.end, stations))
        for row in table.plots
    ]
    for side in sides:
        _build_houses(scenery, side)
    for side, row in zip(sides, table.plots, strict=True):
        _furnish(scenery, side, table.lamps_every_m, getattr(row, "trees", True))
    parking = table.parking
    for side in sides[: parking.num_plots]:
        free = parking.free_left if side.side > 0 else parking.free_right
        _park_cars(scenery, side, parking.share, free)


def _build_houses(scenery: Scenery, side: Side) -> None:
    """Place houses behind front gardens, each enclosed by a hedge, a wall or a fence."""
    rng, pavement_m, table = scenery.rng, scenery.ground.pavement_m, _TABLES.plots
    boundary = pavement_m + table.boundary_beyond_pavement_m
    station = side.begin_m
    while station < side.end_m - table.shortest_m:
        width = rng.uniform(*table.width_m)
        middle = station + width / 2
        heading = side.heading(middle)
        garden = rng.uniform(*table.garden_m)
        depth = rng.uniform(*table.depth_m)
        home = models.house(rng, width - rng.uniform(*table.beside_house_m), depth)
        centre = side.at(middle, boundary + garden + depth / 2)
        house_gap_m = pavement_m + table.house_beyond_pavement_m
        is_built = scenery.put(home, centre, heading, kerb_gap_m=house_gap_m)
        # A plot without a house always has a tree.
        if rng.random() < (table.tree.share if is_built else 1.0):
            tree, foot = models.tree(rng)
            inset_m = table.tree.from_ends_m
            tree_station = station + rng.uniform(inset_m, width - inset_m)
            xy = side.at(tree_station, boundary + rng.uniform(*table.tree.behind_boundary_m))
            scenery.put(tree, xy, 0.0, foot, pavement_m)
        _close_off(scenery, side, (station, station + width), boundary, has_gate=is_built)
        station += width


def _close_off(
    scenery: Scenery, side: Side, span: tuple[float, float], beyond_m: float, has_gate: bool
) -> None:
    """Enclose a plot by a boundary of a random kind, with a gap in the middle for a gate."""
    rng, table = scenery.rng, _TABLES.plots
    choice = int(rng.integers(len(table.boundaries)))
    light = float(rng.uniform(*table.paint))
    # A height is drawn for every kind, so the number of random draws does not depend on the kind.
    height_m = [float(rng.uniform(*row.height_m)) for row in table.boundaries][choice]
    row = table.boundaries[choice]
    make = partial(models.hedge, rng, height_m)
    if row.kind == "wall":
        make = partial(panel, "wall", height=height_m, material=Material[row.material])
    elif row.kind == "picket_fence":
        low_m, high_m = (share * height_m for share in row.rails)
        make = partial(
            panel, "picket_fence", height=height_m, low_rail=low_m, high_rail=high_m,
            tint=(light, light, light),
        )  # fmt: skip
    begin, end = span
    middle, half_m = (begin + end) / 2, table.gate_half_m
    spans = [(begin, middle - half_m), (middle + half_m, end)] if has_gate else [span]
    for first_station, last_station in spans:
        # Panels in a straight line, each on the ground below it
        start = side.at(first_station, beyond_m)
        line = side.at(last_station, beyond_m) - start
        length_m, heading = float(np.linalg.norm(line)), float(np.arctan2(line[1], line[0]))
        num_panels = max(1, round(length_m / table.panel_m))
        middles = start + line * (np.arange(num_panels)[:, None] + 0.5) / num_panels
        is_clear = scenery.ground.distance(middles) > beyond_m - table.fence_clear_m
        for middle in middles[is_clear]:
            scenery.put(make(length_m / num_panels), middle, heading)


def _furnish(scenery: Scenery, side: Side, spacing_m: float, has_trees: bool) -> None:
    """Place lamp posts, trees, signs and bins along the kerb."""
    rng = scenery.rng
    first_m = side.begin_m + rng.uniform(*_TABLES.first_lamp_m)
    for station in np.arange(first_m, side.end_m, spacing_m):
        for row in _TABLES.furniture:
            if row.kind == "tree" and not has_trees:
                continue
            if hasattr(row, "share") and rng.random() >= row.share:
                continue
            ahead_m = row.ahead_m if hasattr(row, "ahead_m") else row.ahead_share * spacing_m
            heading, solid = side.heading(station), None
            if row.kind == "tree":
                mesh, solid = models.tree(rng)
                heading = 0.0
            elif row.kind == "sign_post":
                mesh = models.sign_post(rng)
                heading += np.pi * (side.side > 0)  # signs face the traffic
            else:
                mesh = model(row.kind)
            xy = side.at(station + ahead_m, row.beyond_kerb_m)
            scenery.put(mesh, xy, heading, solid, row.clear_of_kerb_m)


def _park_cars(
    scenery: Scenery, side: Side, share: float, keep_free: Sequence[Sequence[float]]
) -> None:
    """Park cars along the kerb, in a share of the parking spaces."""
    rng, table = scenery.rng, _TABLES.parked
    station = side.begin_m + table.from_ends_m
    while station < side.end_m - table.from_ends_m:
        is_taken = rng.random() < share
        xy = side.at(station, table.beyond_kerb_m + rng.uniform(*table.vary_m))
        gap_m = table.from_gap_m
        is_kept_free = any(begin - gap_m < station < end + gap_m for begin, end in keep_free)
        is_at_kerb = float(scenery.ground.distance(xy[None])[0]) > table.on_edge_m
        if is_taken and not is_kept_free and is_at_kerb:
            scenery.park(xy, side.forward(station))
        station += rng.uniform(*table.space_m)


def _line_motorway(scenery: Scenery, road: Road, end_m: float) -> None:
    """Place guard rails, lamps, signs, a noise barrier, trees and bushes along the highway."""
    rng, table = scenery.rng, _TABLES.motorway
    left, right = (Side(road, side, 0.0, end_m) for side in (1, -1))
    rail, barrier = (panel(name, table.panel_m) for name in ("guard_rail", "noise_barrier"))
    panel_stations = np.arange(table.begin_m, end_m, table.panel_m)
    # Rails outside the road and beside its median
    median_m = -road.left_m + table.rails_beside_median_m
    for station in panel_stations:
        for beyond_m in (table.rails_beyond_edge_m, median_m):
            for side in (left, right):
                scenery.put(rail, side.at(station, beyond_m), side.heading(station))
    # Lamps in the median, signs beside the road
    for station in np.arange(table.lamps.begin_m, end_m, table.lamps.every_m):
        lamp_xy = left.at(station, -road.left_m)
        scenery.put(model("lamp_post"), lamp_xy, left.heading(station))
        for side in (left, right):
            sign_m = float(station * _vary(rng, table.signs.vary))
            sign_xy = side.at(sign_m, table.signs.beyond_edge_m)
            scenery.put(models.sign_post(rng), sign_xy, side.heading(sign_m))
    # The noise barrier on the left; elsewhere trees and bushes
    begin_m, stop_m = rng.uniform(*table.barrier.begin_m), rng.uniform(*table.barrier.end_m)
    for side in (left, right):
        for station in panel_stations:
            heading = side.heading(station)
            if side is left and begin_m < station < stop_m:
                scenery.put(barrier, side.at(station, table.barrier.beyond_edge_m), heading)
            elif rng.random() < table.tree.share:
                tree, foot = models.tree(rng)
                beyond_m = rng.uniform(*table.tree.beyond_edge_m)
                scenery.put(tree, side.at(station, beyond_m), solid=foot)
            elif rng.random() < table.bush.share:
                height_m = float(rng.uniform(*table.bush.height_m))
                bush = models.hedge(rng, height_m, rng.uniform(*table.bush.length_m))
                beyond_m = rng.uniform(*table.bush.beyond_edge_m)
                scenery.put(bush, side.at(station, beyond_m), heading)


# Traffic


class Traffic:
    """Collector of ``actors`` that collide neither with each other nor with static objects."""

    def __init__(
        self, ego: Driving, scenery: Scenery, lanes: Mapping[str, Any], curves: Mapping[str, Curve]
    ) -> None:
        """Start without actors. ``lanes``, rows of scenes.yaml, and ``curves`` are by name."""
        self.actors: list[Actor] = []
        self._ground, self._rng = scenery.ground, scenery.rng
        self._lanes, self._curves = lanes, curves
        self._times = np.arange(*SPAN_S, _OUTLINE_STEP_S)
        self._static = Rectangles.joined(scenery.footprints)
        outline = Rectangles.of(model("ego_vehicle"), ego.poses(self._times), _EGO_MARGIN_M)
        self._moving = outline.rows(None)

    def add_row(self, row: Any, stations: Mapping[str, float]) -> None:
        """Add the actor or convoy of a row of ``traffic`` in scenes.yaml.

        ``stations`` are arc lengths (m) by name. Actors that fit nowhere are left out.
        """
        station = resolve(row.station, stations)
        if not hasattr(row, "gap_m"):
            self._add(row, station)
            return
        for number in _CONVOY:
            self._add(row, station + number * (row.gap_m * _vary(self._rng, _CONVOY_VARIES)))

    def _add(self, row: Any, station: float) -> None:
        """Add an actor near a station. Draw until the actor fits, 40 times at most."""
        speed = None  # None: each try draws another
        if hasattr(row, "knots"):
            speed = Speed(*row.knots)
        elif not (hasattr(row, "vary_m_s") or isinstance(row.m_s, list)):
            factor = _vary(self._rng, row.vary) if hasattr(row, "vary") else 1.0
            speed = Speed((0.0, row.m_s * factor))
        for _ in range(_TRIES):
            actor = self._draw(row, station, speed)
            has_limbs = len(actor.bodies) > actor.num_solid
            margin_m = _LIMBS_MARGIN_M if has_limbs else _ACTOR_MARGIN_M
            outlines = [
                Rectangles.of(body.mesh, body.trajectory.poses(self._times), margin_m)
                for body in actor.bodies[: actor.num_solid]
            ]
            if not any(self._touches(outline) for outline in outlines):
                self.actors.append(actor)
                actor_outlines = [outline.rows(None) for outline in outlines]
                self._moving = Rectangles.joined([self._moving, *actor_outlines])
                return

    def _touches(self, outline: Rectangles) -> bool:
        """Return True if an outline, by time, overlaps a static object or an actor."""
        if motion.overlap(outline, self._moving).any():
            return True
        # Only static objects near the outline at some time are compared.
        x, y = (self._static.centre[:, axis] - outline.centre[:, axis, None] for axis in (0, 1))
        time_row, static_row = np.nonzero(x * x + y * y < _TOUCH_M**2)
        near = self._static.rows(static_row)
        return bool(motion.overlap(outline.rows(time_row), near).any())

    def _draw(self, row: Any, station: float, speed: Speed | None) -> Actor:
        """Draw an actor beside a station of the road at the meeting time."""
        along, rng, ground = self._lanes[row.lane], self._rng, self._ground
        has_range, is_walker = isinstance(along.offset_m, list), row.kind == "walker"
        offset_m = rng.uniform(*along.offset_m) if has_range else along.offset_m
        lane = Lane(self._curves[along.road], offset_m, getattr(along, "forward", True))
        arc_m = lane.at(station + rng.uniform(-row.slack_m, row.slack_m))

        def lift(arc_m: Float) -> Float:
            """Return the (N,) heights above the terrain at (N,) arc lengths: 0 to the kerb's."""
            beyond_m = ground.distance(lane.curve(arc_m))
            return ground.kerb_m * np.clip(beyond_m / _KERB_RAMP_M, 0, 1)

        if speed is None:
            if isinstance(row.m_s, list):
                m_s = rng.uniform(*row.m_s)
            else:
                m_s = row.m_s + rng.uniform(-row.vary_m_s, row.vary_m_s)
            speed = Speed((0.0, m_s))
        driving = Driving(
            lane.curve, speed, arc_m, _TABLES.meeting_s, ground.terrain, WHEELBASE_M[row.kind],
            lift if is_walker else None, upright=is_walker,
        )  # fmt: skip
        # The kind is the name of a function: car, truck, cyclist or walker.
        actor: Actor = getattr(models, row.kind)(driving, len(self.actors), rng)
        return actor


PRESETS = {
    "street": (_TABLES.street, _lay_street),
    "static": (_TABLES.street, _lay_street),  # only the ego vehicle moves
    "crossing": (_TABLES.crossing, _lay_crossing),
    "highway": (_TABLES.highway, _lay_highway),
}
"""Name of the preset -> row of scenes.yaml, and function that returns its curves and stations."""
