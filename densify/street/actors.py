# SPDX-License-Identifier: MIT
"""Make the meshes of vehicles, cyclists and pedestrians, and join their parts.

The origin of a vehicle mesh is on the ground midway between the axles, x forward, z up.
"""

from __future__ import annotations

import colorsys
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from itertools import pairwise

import numpy as np

from densify.geometry.types import Float
from densify.street.materials import Material
from densify.street.mesh import WHITE, Mesh, Tint, ball, box, boxes, frustum, tube
from densify.street.motion import Driving, Limb, Towed
from densify.street.world import Body

WHEELBASE_M = {"car": 2.6, "truck": 3.4, "trailer": 8.0, "cyclist": 1.05, "walker": 0.2}
DURATION_S = 16
SPAN_S = (-1.0, DURATION_S + 1.0)  # times with poses
_KINGPIN_M = -1.2
_EDGE_M = 0.78  # height from which a car loses rays as its windows do
_PAINTS: tuple[Tint, ...] = (
    (0.92, 0.92, 0.92), (0.62, 0.64, 0.66), (0.14, 0.14, 0.16), (0.62, 0.10, 0.09),
    (0.12, 0.24, 0.52), (0.30, 0.33, 0.36), (0.20, 0.36, 0.30), (0.78, 0.66, 0.36),
    (0.06, 0.06, 0.07),
)  # fmt: skip


@dataclass(frozen=True)
class Actor:
    """An object of the street, such as a car or a pedestrian."""

    name: str  # kind of the object
    # Rigid parts. Only the first `num_solid` parts are tested for collisions.
    bodies: tuple[Body, ...]
    num_solid: int = 1


def any_paint(rng: np.random.Generator) -> Tint:
    """Return a random colour of car paint."""
    return _PAINTS[int(rng.integers(len(_PAINTS)))]


def any_cloth(rng: np.random.Generator) -> Tint:
    """Return a random colour of clothes."""
    r, g, b = colorsys.hsv_to_rgb(rng.random(), rng.uniform(0.2, 0.8), rng.uniform(0.25, 0.85))
    return (r, g, b)


def _wheels(xs: Sequence[float], y: float, radius: float, width: float) -> list[Mesh]:
    """Return the tyres and rims on both sides of the axles at ``xs``."""
    kinds = ((0.0, 1.0, Material.RUBBER, 16), (0.01, 0.6, Material.METAL, 12))
    return [
        tube((x, s * y - width / 2 - out, radius), (x, s * y + width / 2 + out, radius),
             radius * share, material, num_sides=sides)
        for x in xs for s in (-1, 1) for out, share, material, sides in kinds
    ]  # fmt: skip


def _panels(low: Float, high: Float) -> Float:
    """Return (K-1,4,3) quads between a lower and an upper line of (K,3) points."""
    return np.stack([low[:-1], low[1:], high[1:], high[:-1]], axis=1)


def _both_sides(left: Float, material: Material, tint: Tint = WHITE) -> Mesh:
    """Return a mesh of (K,4,3) quads on the left and their mirror images on the right."""
    right = left * [1.0, -1.0, 1.0]
    return Mesh.quads(np.concatenate([left, right]), material, tint)


def _across(
    profile: Sequence[tuple[float, float, float]], material: Material, tint: Tint = WHITE
) -> Mesh:
    """Return a sheet across the car through the lines (x, z, half width)."""
    left = np.array(profile)[:, [0, 2, 1]]
    right = left * [1.0, -1.0, 1.0]
    corners = np.stack([right[:-1], right[1:], left[1:], left[:-1]], axis=1)
    return Mesh.quads(corners, material, tint)


def car_mesh(paint: Tint, rng: np.random.Generator) -> Mesh:
    """Return a saloon or estate, 4.2 to 4.7 m long: shell, glass, interior and wheels."""
    estate = bool(rng.random() < 0.4)
    front, rear = 2.15 + rng.uniform(0.0, 0.2), -2.05 - rng.uniform(0.0, 0.2)
    wide, roof, belt = 0.88, 1.44 + rng.uniform(-0.03, 0.16) * estate, 0.92
    top = 0.64  # half width of the roof
    cowl, screen, rear_roof = 1.05, 0.35, rear + (0.45 if estate else 0.95)
    deck = rear + (0.08 if estate else 0.45)
    # side panels between the sill, the upper edge of the painted part, and the shoulder
    shoulder = np.array(
        [
            (rear, wide, 0.62),
            (rear + 0.03, wide, belt),
            (deck, wide, belt),
            (cowl, wide, belt),
            (front - 0.12, wide, 0.74),
            (front, wide, 0.60),
        ]
    )
    sill = shoulder * (1, 1, 0) + np.outer([0.30, 0.24, 0.22, 0.22, 0.26, 0.30], (0, 0, 1))
    edge = np.minimum(shoulder, (np.inf, np.inf, _EDGE_M))
    # pillars and glass in turn, between shoulder line and roof
    low, high = (
        np.array([(x, y, z) for x in (a, a + 0.13 * (-0.35 - a), -0.35, -0.25,
                                      b - 0.10 * (b + 0.25), b)])
        for a, b, y, z in ((deck, cowl, wide, belt), (rear_roof, screen, top, roof))
    )  # fmt: skip
    band = _panels(low, high)
    nose = [(front - 0.02, 0.28, wide), (front, 0.60, wide), (front - 0.12, 0.74, wide)]
    tail = [(rear, 0.62, wide), (rear + 0.02, 0.28, wide)]
    boot = [(deck, belt, wide), (rear + 0.03, belt, wide), tail[0]]
    return Mesh.join([
        _both_sides(_panels(sill, edge), Material.BODYWORK, paint),
        _both_sides(_panels(edge, shoulder), Material.FRAME, paint),
        _across(nose, Material.BODYWORK, paint),
        _across([nose[-1], (cowl, belt, wide)], Material.FRAME, paint),
        _across(boot, Material.FRAME, paint),
        _across(tail, Material.BODYWORK, paint),
        _across([(rear_roof, roof, top), (screen, roof + 0.01, top)], Material.FRAME, paint),
        _across([(front - 0.02, 0.24, wide), (rear, 0.24, wide)], Material.RUBBER),
        _both_sides(band[::2], Material.FRAME, paint),
        _both_sides(band[1::2], Material.GLASS, paint),
        _across([(cowl, belt, wide), (screen, roof, top)], Material.GLASS, paint),
        _across([(rear_roof, roof, top), (deck, belt, wide)], Material.GLASS, paint),
        _inside_and_wheels(),
        *_lights(front, rear, wide),
    ])  # fmt: skip


@lru_cache(maxsize=1)
def _inside_and_wheels() -> Mesh:
    seats = [
        part
        for x in (0.05, -0.95)
        for y in (-0.38, 0.38)
        for part in (
            ((x - 0.25, y - 0.25, 0.35), (x + 0.25, y + 0.25, 0.58)),
            ((x - 0.35, y - 0.25, 0.35), (x - 0.22, y + 0.25, 1.12)),
        )
    ]
    dashboard = ((0.65, -0.8, 0.5), (1.0, 0.8, 0.90))
    driver = [
        frustum((-0.2, 0.18, 0.55), (0.1, 0.58, 1.10), Material.CLOTH, (0.3, 0.3, 0.4), (0.8, 0.7)),
        ball((-0.05, 0.38, 1.22), (0.10, 0.09, 0.12), Material.SKIN),
    ]
    half = WHEELBASE_M["car"] / 2
    wheels = _wheels((-half, half), 0.79, 0.32, 0.2)
    return Mesh.join([boxes([*seats, dashboard], Material.UPHOLSTERY), *driver, *wheels])


def _lights(front: float, rear: float, wide: float) -> list[Mesh]:
    sides = (-wide + 0.05, wide - 0.40)
    lamps = [
        boxes([((front - 0.2, y, 0.52), (front + 0.01, y + 0.35, 0.66)) for y in sides],
              Material.LAMP),
        boxes([((rear - 0.01, y, 0.64), (rear + 0.1, y + 0.35, 0.80)) for y in sides],
              Material.LAMP, (0.7, 0.08, 0.06)),
    ]  # fmt: skip
    plate = box((rear - 0.015, -0.26, 0.42), (rear + 0.1, 0.26, 0.53), Material.PAINT)
    return [*lamps, plate]


def car(motion: Driving, instance: int, rng: np.random.Generator) -> Actor:
    """Return a parked or driving car."""
    return Actor("car", (Body(car_mesh(any_paint(rng), rng), motion, instance),))


def truck(motion: Driving, instance: int, rng: np.random.Generator) -> Actor:
    """Return a 16 m articulated truck. The trailer follows the tractor through turns."""
    paint, tarpaulin = any_paint(rng), any_cloth(rng)
    half, trailer_half = WHEELBASE_M["truck"] / 2, WHEELBASE_M["trailer"] / 2
    front, back = half + 1.3, -trailer_half - 3.7
    # the corners of the windscreen at its foot and its head, and of the side windows
    foot, head = np.array([[(x, -1.2, z), (x, 1.2, z)]
                           for x, z in ((front, 1.75), (front - 0.15, 2.6))])  # fmt: skip
    panes = [[foot[0], foot[1], head[1], head[0]]]
    for a, b in zip(foot, head, strict=True):
        panes.append([(front - 0.9, *a[1:]), a, b, (front - 0.9, *b[1:])])
    cab = [
        box((front - 2.2, -1.22, 0.55), (front, 1.22, 1.75), Material.BODYWORK, paint),
        frustum((front - 2.2, -1.22, 2.6), (front - 0.15, 1.22, 3.5), Material.BODYWORK, paint,
                (0.85, 0.9)),
        box((front - 2.2, -1.22, 1.75), (front - 0.9, 1.22, 2.6), Material.BODYWORK, paint),
        Mesh.quads(np.array(panes), Material.GLASS, paint),
        box((-3.0, -0.5, 0.7), (front - 2.2, 0.5, 1.05), Material.METAL),
        boxes([((front - 0.05, y - 0.25, 0.7), (front + 0.02, y + 0.25, 0.95))
               for y in (-0.9, 0.9)], Material.LAMP),
        *_wheels((-half, half), 1.05, 0.5, 0.32),
    ]  # fmt: skip
    load = [
        box((back, -1.25, 1.2), (trailer_half + 1.0, 1.25, 3.9), Material.CLOTH, tarpaulin),
        box((back, -0.5, 0.9), (trailer_half + 0.5, 0.5, 1.2), Material.METAL),
        boxes([((back - 0.05, y - 0.2, 0.95), (back + 0.1, y + 0.2, 1.15))
               for y in (-1.0, 1.0)], Material.LAMP, (0.7, 0.1, 0.1)),
        *_wheels([-trailer_half + x for x in (-1.3, 0.0, 1.3)], 1.05, 0.5, 0.32),
    ]  # fmt: skip
    towed = Towed(motion, _KINGPIN_M, WHEELBASE_M["trailer"], *SPAN_S)
    bodies = (Body(Mesh.join(cab), motion, instance), Body(Mesh.join(load), towed, instance))
    return Actor("truck", bodies, num_solid=2)


def _leg(length: float, radius: float, cloth: Tint) -> Mesh:
    """Return a leg or an arm that hangs from its hinge at the origin."""
    return Mesh.join(
        [
            tube((0, 0, 0.02), (0, 0, -length), (radius, radius * 0.6), Material.CLOTH, cloth),
            box((-0.08, -0.05, -length - 0.04), (0.18, 0.05, -length + 0.04), Material.RUBBER),
        ]
    )


def _arm(cloth: Tint) -> Mesh:
    return Mesh.join(
        [
            tube((0, 0, 0.02), (0.04, 0, -0.52), (0.055, 0.04), Material.CLOTH, cloth),
            ball((0.05, 0, -0.60), (0.05, 0.04, 0.07), Material.SKIN),
        ]
    )


def _upper_body(hip_m: float, cloth: Tint, hair: Tint) -> list[Mesh]:
    return [
        frustum((-0.12, -0.17, hip_m - 0.05), (0.12, 0.17, hip_m + 0.55), Material.CLOTH, cloth,
                (1.0, 1.25)),
        tube((0, 0, hip_m + 0.53), (0.01, 0, hip_m + 0.66), 0.055, Material.SKIN),
        ball((0.02, 0, hip_m + 0.75), (0.10, 0.08, 0.12), Material.SKIN),
        ball((0.0, 0, hip_m + 0.79), (0.105, 0.09, 0.10), Material.CLOTH, hair),
    ]  # fmt: skip


def walker(motion: Driving, instance: int, rng: np.random.Generator) -> Actor:
    """Return a pedestrian: a trunk with two legs and two arms that swing in step."""
    hip, cloth, trousers = 0.90 + rng.uniform(-0.06, 0.05), any_cloth(rng), any_cloth(rng)
    hair = (0.25 * rng.random(), 0.18 * rng.random(), 0.1 * rng.random())
    swing, stride = 0.50, 1.45
    bodies = [Body(Mesh.join(_upper_body(hip, cloth, hair)), motion, instance)]
    leg_mesh, arm_mesh = _leg(hip - 0.06, 0.085, trousers), _arm(cloth)
    for side, phase in ((1, 0.0), (-1, np.pi)):
        leg = Limb(motion, (0.0, 0.10 * side, hip), swing, stride, phase)
        arm = Limb(motion, (0.0, 0.25 * side, hip + 0.50), 0.8 * swing, stride, phase + np.pi)
        bodies.append(Body(leg_mesh, leg, instance))
        bodies.append(Body(arm_mesh, arm, instance))
    return Actor("walker", tuple(bodies))


def cyclist(motion: Driving, instance: int, rng: np.random.Generator) -> Actor:
    """Return a bicycle with a rider whose legs pedal."""
    half, paint, cloth = WHEELBASE_M["cyclist"] / 2, any_cloth(rng), any_cloth(rng)
    parts = []
    for x in (-half, half):
        angle = np.linspace(0, 2 * np.pi, 17)
        rim = np.column_stack([x + 0.33 * np.cos(angle), 0 * angle, 0.34 + 0.33 * np.sin(angle)])
        parts += [tube(*ends, 0.022, Material.RUBBER, num_sides=4) for ends in pairwise(rim)]
        parts += [tube(rim[i], rim[i + 8], 0.006, Material.METAL, num_sides=4)
                  for i in range(0, 8, 2)]  # fmt: skip
    seat, crank, head, bar = (-0.22, 0, 0.92), (-0.08, 0, 0.34), (0.36, 0, 0.86), (0.34, 0, 1.02)
    rear, ahead = (-half, 0, 0.34), (half, 0, 0.34)
    frame = (seat, crank), (crank, head), (seat, head), (seat, rear), (crank, rear), (ahead, bar)
    parts += [
        *(tube(*ends, 0.02, Material.METAL, paint) for ends in frame),
        tube((0.34, -0.28, 1.02), (0.34, 0.28, 1.02), 0.018, Material.METAL),
        tube((-0.20, 0, 0.94), (0.08, 0, 1.42), (0.15, 0.19), Material.CLOTH, cloth),
        ball((0.20, 0, 1.60), (0.10, 0.085, 0.12), Material.SKIN),
        ball((0.18, 0, 1.65), (0.12, 0.10, 0.10), Material.CLOTH, any_cloth(rng)),
        *(tube((0.06, y, 1.38), (0.33, y * 1.2, 1.04), 0.045, Material.CLOTH, cloth)
          for y in (-0.2, 0.2)),
    ]  # fmt: skip
    bodies = [Body(Mesh.join(parts), motion, instance)]
    for side, phase in ((1, 0.0), (-1, np.pi)):
        leg = Limb(motion, (-0.16, 0.1 * side, 0.95), 0.35, 5.0, phase)
        bodies.append(Body(_leg(0.68, 0.08, any_cloth(rng)), leg, instance))
    return Actor("cyclist", tuple(bodies))
