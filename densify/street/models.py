# SPDX-License-Identifier: MIT
"""Make the things in the street from the shapes in models.yaml, varied at random.

The origin of a vehicle mesh is on the ground midway between the axles, x forward, z up.
"""

from __future__ import annotations

import colorsys
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import lru_cache
from itertools import pairwise
from typing import Any

import numpy as np

from densify.geometry.types import Float
from densify.street import read_table
from densify.street.mesh import (
    WHITE,
    Material,
    Mesh,
    Point,
    Tint,
    ball,
    box,
    frustum,
    leaves,
    tube,
)
from densify.street.motion import DURATION_S, Driving, Limb, Towed
from densify.street.world import Body

_SHAPES = read_table("models")
_SOLIDS: dict[str, Callable[..., Mesh]] = {
    "box": box, "frustum": frustum, "tube": tube, "ball": ball,
}  # fmt: skip
WHEELBASE_M: dict[str, float] = vars(_SHAPES.wheelbase_m)
SPAN_S = (-1.0, DURATION_S + 1.0)  # times with poses
_CACHED_MODELS = 256


@dataclass(frozen=True)
class Actor:
    """An object of the street, such as a car or a pedestrian."""

    name: str  # kind of the object
    # Rigid parts. Only the first `num_solid` parts are tested for collisions.
    bodies: tuple[Body, ...]
    num_solid: int = 1


# Models of solids


@lru_cache(_CACHED_MODELS)
def model(name: str, **named: Any) -> Mesh:
    """Return a model of models.yaml; ``named`` are the lengths, colours and materials it names."""
    return Mesh.join([_solid(solid, named) for solid in getattr(_SHAPES, name)])


def panel(name: str, length_m: float, **named: Any) -> Mesh:
    """Return a piece of a fence, wall or rail, this long along x."""
    return model(name, left=-length_m / 2, right=length_m / 2, **named)


def _solid(row: Any, named: dict[str, Any]) -> Mesh:
    fields = {name: resolve(value, named) for name, value in vars(row).items()}
    material = fields.pop("material")
    fields["material"] = material if isinstance(material, Material) else Material[material]
    make, offsets = _SOLIDS[fields.pop("solid")], fields.pop("at", None)
    if "spaced" in fields:
        spaced = {key: resolve(value, named) for key, value in vars(fields.pop("spaced")).items()}
        x = np.arange(spaced["first"], spaced["end"], spaced["step_m"])
        offsets = np.column_stack([x, 0 * x, 0 * x])
    if offsets is not None:
        fields |= {end: np.add(fields[end], offsets) for end in ("low", "high")}
    return make(**fields)


def resolve(value: Any, named: Mapping[str, Any]) -> Any:
    """Return a value of a table with names replaced, and [name, number] by their sum."""
    if isinstance(value, str):
        return named.get(value, value)
    if not isinstance(value, list):
        return value
    if len(value) == 2 and isinstance(value[0], str):
        name, beyond_m = value
        return named[name] + beyond_m
    return [resolve(item, named) for item in value]


def _any_paint(rng: np.random.Generator) -> Tint:
    return tuple(_SHAPES.paints[int(rng.integers(len(_SHAPES.paints)))])


def _any_cloth(rng: np.random.Generator) -> Tint:
    cloth = _SHAPES.cloth
    return colorsys.hsv_to_rgb(
        rng.random(), rng.uniform(*cloth.saturation), rng.uniform(*cloth.value)
    )


# Vehicles


def _wheels(row: Any) -> list[Mesh]:
    """Return the tyres and rims on both sides of the axles."""
    meshes, z = [], row.radius_m
    for x in row.axles_m:
        for y in (-row.half_track_m, row.half_track_m):
            for ring in _SHAPES.wheel:
                right, left = (
                    y + sign * row.width_m / 2 + sign * ring.stands_out_m for sign in (-1, 1)
                )
                radius_m, material = z * ring.radius_share, Material[ring.material]
                meshes.append(
                    tube((x, right, z), (x, left, z), radius_m, material, WHITE, ring.num_sides)
                )
    return meshes


def _panels(low: Float, high: Float) -> Float:
    """Return (K-1,4,3) quads between a lower and an upper line of (K,3) points."""
    return np.stack([low[:-1], low[1:], high[1:], high[:-1]], axis=1)


def _both_sides(left: Float, material: Material, tint: Tint) -> Mesh:
    """Return a mesh of (K,4,3) quads on the left and their mirror images on the right."""
    right = left * [1.0, -1.0, 1.0]
    return Mesh.quads(np.concatenate([left, right]), material, tint)


def _sheet(row: Any, named: dict[str, Any], paint: Tint) -> Mesh:
    """Return a sheet across the car through its lines (x, z, half width)."""
    left = np.array(resolve(row.lines, named))[:, [0, 2, 1]]
    tint = WHITE if hasattr(row, "unpainted") else paint
    return Mesh.quads(_panels(left * [1.0, -1.0, 1.0], left), Material[row.material], tint)


def car_mesh(paint: Tint, rng: np.random.Generator) -> Mesh:
    """Return a saloon or estate, 4.2 to 4.7 m long: shell, glass, interior and wheels."""
    shape = _SHAPES.car
    style = "estate" if bool(rng.random() < shape.estate_share) else "saloon"
    front = shape.front_m + rng.uniform(*shape.longer_m)
    rear = shape.rear_m - rng.uniform(*shape.longer_m)
    roof = shape.roof_m + rng.uniform(*shape.estate_higher_m) * (style == "estate")
    named = {
        "front": front, "rear": rear, "roof": roof, "belt": shape.belt_m,
        "wide": shape.half_width_m, "narrow": shape.roof_half_width_m,
        "cowl": shape.cowl_m, "screen": shape.screen_m,
        "deck": rear + getattr(shape.deck_ahead_of_rear_m, style),
        "rear_roof": rear + getattr(shape.rear_roof_ahead_of_rear_m, style),
    }  # fmt: skip
    x = [resolve(line.x, named) for line in shape.sides]
    shoulder, sill = (
        np.column_stack([x, np.full(len(x), shape.half_width_m), z])
        for z in zip(*((line.shoulder_m, line.sill_m) for line in shape.sides), strict=True)
    )
    edge = np.minimum(shoulder, (np.inf, np.inf, shape.frame_from_m))
    band = _panels(_pillars(named, "deck", "cowl", "wide", "belt"),
                   _pillars(named, "rear_roof", "screen", "narrow", "roof"))  # fmt: skip
    return Mesh.join(
        [
            _both_sides(_panels(sill, edge), Material.BODYWORK, paint),
            _both_sides(_panels(edge, shoulder), Material.FRAME, paint),
            *(_sheet(row, named, paint) for row in shape.shell),
            _both_sides(band[::2], Material.FRAME, paint),
            _both_sides(band[1::2], Material.GLASS, paint),
            *(_sheet(row, named, paint) for row in shape.windows),
            model("car_inside"),
            *_wheels(shape.wheels),
            model("car_lights", front=front, rear=rear),
        ]
    )


def _pillars(named: dict[str, float], rear: str, front: str, half_width: str, z: str) -> Float:
    """Return (6,3) ends of the rear, door and front pillars along the left side of a car."""
    begin, end, shape = named[rear], named[front], _SHAPES.car
    door_rear, door_front = shape.door_pillar_m
    x = [
        begin, begin + shape.rear_pillar_share * (door_rear - begin), door_rear,
        door_front, end - shape.front_pillar_share * (end - door_front), end,
    ]  # fmt: skip
    return np.array([(along, named[half_width], named[z]) for along in x])


def parked_car(instance: int, rng: np.random.Generator) -> Mesh:
    """Return a car of any paint and shape."""
    return car_mesh(_any_paint(rng), rng).of_instance(instance)


def car(motion: Driving, instance: int, rng: np.random.Generator) -> Actor:
    """Return a driving car."""
    return Actor("car", (Body(parked_car(instance, rng), motion, instance),))


def truck(motion: Driving, instance: int, rng: np.random.Generator) -> Actor:
    """Return a 16 m articulated truck. The trailer follows the tractor through turns."""
    shape, paint, tarpaulin = _SHAPES.truck, _any_paint(rng), _any_cloth(rng)
    glass = Mesh.quads(np.array(shape.glass), Material.GLASS, paint)
    cab = [model("truck_cab", paint=paint), glass, model("truck_chassis"), *_wheels(shape.wheels)]
    load = [model("truck_load", tarpaulin=tarpaulin), *_wheels(shape.trailer_wheels)]
    towed = Towed(motion, shape.kingpin_m, WHEELBASE_M["trailer"], *SPAN_S)
    bodies = (Body(Mesh.join(cab), motion, instance), Body(Mesh.join(load), towed, instance))
    return Actor("truck", bodies, num_solid=2)


# People


def walker(motion: Driving, instance: int, rng: np.random.Generator) -> Actor:
    """Return a pedestrian: a trunk with two legs and two arms that swing in step."""
    shape = _SHAPES.walker
    hip_m, cloth, trousers = (
        shape.hip_m + rng.uniform(*shape.taller_m), _any_cloth(rng), _any_cloth(rng),
    )  # fmt: skip
    hair = tuple(channel * rng.random() for channel in shape.darkest_hair)
    trunk = model("walker_trunk", hip=hip_m, cloth=cloth, hair=hair)
    foot_m = -(hip_m + shape.leg_shorter_than_hip_m)
    meshes = {
        "leg": model("leg", foot=foot_m, radius=tuple(shape.leg_radius_m), cloth=trousers),
        "arm": model("arm", cloth=cloth),
    }
    hinge_m = {"leg": hip_m, "arm": hip_m + shape.shoulder_above_hip_m}
    bodies = [Body(trunk, motion, instance)]
    for side, phase in ((1, 0.0), (-1, np.pi)):
        for limb, behind in (("leg", 0.0), ("arm", np.pi)):
            hinge = (0.0, getattr(shape.half_width_m, limb) * side, hinge_m[limb])
            swing = getattr(shape.swing_rad, limb)
            limb_motion = Limb(motion, hinge, swing, shape.stride_m, phase + behind)
            bodies.append(Body(meshes[limb], limb_motion, instance))
    return Actor("walker", tuple(bodies))


def cyclist(motion: Driving, instance: int, rng: np.random.Generator) -> Actor:
    """Return a bicycle with a rider whose legs pedal."""
    shape, paint, cloth = _SHAPES.cyclist, _any_cloth(rng), _any_cloth(rng)
    frame = model("bicycle_and_rider", paint=paint, cloth=cloth, helmet=_any_cloth(rng))
    wheels = [tube for x in shape.wheel.x_m for tube in _spoked_wheel(shape.wheel, x)]
    bodies = [Body(Mesh.join([*wheels, frame]), motion, instance)]
    x, y, z = shape.hip_m
    for side, phase in ((1, 0.0), (-1, np.pi)):
        pedalling = Limb(motion, (x, y * side, z), shape.swing_rad, shape.stride_m, phase)
        radius_m, cloth = tuple(shape.leg_radius_m), _any_cloth(rng)
        leg = model("leg", foot=-shape.leg_m, radius=radius_m, cloth=cloth)
        bodies.append(Body(leg, pedalling, instance))
    return Actor("cyclist", tuple(bodies))


def _spoked_wheel(row: Any, x: float) -> list[Mesh]:
    angle = np.linspace(0, 2 * np.pi, row.num_sides + 1)
    circle = row.radius_m * np.stack([np.cos(angle), 0 * angle, np.sin(angle)], axis=1)
    rim = circle + (x, 0, row.hub_m)
    half = row.num_sides // 2
    tyre = [
        tube(*ends, row.tyre_m, Material.RUBBER, num_sides=row.num_tube_sides)
        for ends in pairwise(rim)
    ]
    spokes = [
        tube(rim[i], rim[i + half], row.spoke_m, Material.METAL, num_sides=row.num_tube_sides)
        for i in range(0, half, 2)
    ]
    return [*tyre, *spokes]


# Houses and plants


def house(rng: np.random.Generator, width_m: float, depth_m: float) -> Mesh:
    """Return a house with its front along x, facing -y: walls, windows, door and gable roof."""
    shape = _SHAPES.house
    storeys = int(rng.integers(*shape.num_storeys))
    height = shape.storey_m * storeys + shape.attic_m
    wall = Material.BRICK if rng.random() < shape.brick_share else Material.PLASTER
    tint = tuple(rng.uniform(*getattr(shape.tint, wall.name), 3).tolist())
    w, d = width_m / 2, depth_m / 2
    ridge = height + rng.uniform(*shape.ridge_share) * depth_m
    chimney = float(rng.uniform(*shape.chimney_share)) * w
    eaves, top = height + shape.eaves_m, ridge + shape.gable_below_ridge_m
    x, y = w + shape.overhang_m, d + shape.overhang_m
    front = np.array([(-x, -y, eaves), (x, -y, eaves), (x, 0, ridge), (-x, 0, ridge)])
    gables = np.array(
        [[(s, -d, height), (s, d, height), (s, 0, top), (s, 0, top)] for s in (-w, w)]
    )
    return Mesh.join(
        [
            box((-w, -d, shape.foundation_m), (w, d, height), wall, tint),
            Mesh.quads(np.array([front, front * (-1, -1, 1)]), Material.ROOF, tint),
            Mesh.quads(gables, wall, tint),
            *_windows(w, d, storeys),
            model(
                "house_details", front=-d, height=height, ridge=ridge, chimney=chimney, tint=tint
            ),
        ]
    )


def _windows(w: float, d: float, storeys: int) -> list[Mesh]:
    """Return the frames and the panes of a house's front and side walls."""
    shape = _SHAPES.house.window
    frames: list[Point] = []
    panes: list[tuple[Point, Point]] = []
    for storey in range(storeys):
        z = shape.sill_m + _SHAPES.house.storey_m * storey
        top = z + shape.height_m
        for x in np.arange(-w + shape.first_m, w - shape.last_m, shape.step_m):
            if storey == 0 and abs(x) < shape.door_m:
                continue
            frames.append((x, -d, z))
            for begin_m in shape.casement_m:
                left = x + begin_m
                right = left + shape.casement_width_m
                panes.append(((left, -d - shape.casement_out_m, z), (right, -d, top)))
        for y in np.arange(-d + shape.side_first_m, d - shape.side_last_m, shape.side_step_m):
            rear, front = y - shape.side_half_width_m, y + shape.side_half_width_m
            for x in (-w, w):
                out_m = shape.side_out_m
                panes.append(((x - out_m, rear, z), (x + out_m, front, top)))
    corners = np.array(frames).reshape(-1, 3)
    low, high = np.array(panes).reshape(-1, 2, 3).swapaxes(0, 1)
    frame = corners + shape.frame_low_m, corners + shape.frame_high_m
    return [box(*frame, Material.CONCRETE, shape.frame_tint), box(low, high, Material.PANE)]


def tree(rng: np.random.Generator) -> tuple[Mesh, Mesh]:
    """Return the mesh of a tree, and the mesh of its trunk."""
    shape = _SHAPES.tree
    height, spread = rng.uniform(*shape.height_m), rng.uniform(*shape.radius_m)
    crown = max(shape.crown_from_m, shape.crown_share * height)
    thick = shape.trunk_radius.per_m * height + shape.trunk_radius.base_m
    top = np.array([*rng.uniform(*shape.top_m, 2), height * shape.top_share])
    root = (0, 0, shape.root_m)
    trunk = tube(root, top, (thick, thick * shape.trunk_radius.top_share), Material.BARK)
    meshes = [trunk]
    for _ in range(shape.num_branches):
        angle = rng.uniform(0, 2 * np.pi)
        z = rng.uniform(crown, height * shape.branch_to_share)
        reach = spread * rng.uniform(*shape.branch_reach)
        tip = (reach * np.cos(angle), reach * np.sin(angle), z + reach * shape.branch_rise)
        start = (top[0] * z / top[2], top[1] * z / top[2], z)
        meshes.append(tube(start, tip, shape.branch_radius_m, Material.BARK, num_sides=5))
    count = int(shape.leaves_per_m * spread)
    away = rng.normal(size=(count, 3))
    away /= np.linalg.norm(away, axis=1, keepdims=True)
    away *= rng.uniform(shape.leaf_from, 1.0, (count, 1)) ** 0.5
    lump = shape.lump
    wave = np.sin(lump.per_x * away[:, :1] + rng.uniform(*lump.phase))
    lumps = 1 + lump.depth * wave * np.cos(lump.per_y * away[:, 1:2])
    middle = [top[0], top[1], (crown + height) / 2 + shape.crown_up_m]
    radii = [spread, spread, (height - crown) / 2 + shape.crown_taller_m]
    green = tuple(rng.uniform(*channel) for channel in shape.tint)
    meshes.append(leaves(middle + away * lumps * radii, shape.leaf_m, rng, green))
    foot_radius_m = max(thick, shape.foot.radius_m)
    foot = tube(root, (0, 0, shape.foot.height_m), foot_radius_m, Material.BARK)
    return Mesh.join(meshes), foot


def hedge(rng: np.random.Generator, height_m: float, length_m: float) -> Mesh:
    """Return a hedge along x: dense leaves outside, a few twigs inside."""
    shape = _SHAPES.hedge
    half = np.array([length_m / 2, shape.half_depth_m, height_m / 2])
    count = int(shape.leaves_per_m2 * length_m * height_m)
    centres = rng.uniform(-1, 1, (count, 3))
    face = rng.integers(0, 3, count)
    is_outer = rng.random(count) < shape.outer_share
    side = np.sign(centres[np.arange(count), face])
    outermost = rng.uniform(shape.outer_from, 1.0, is_outer.sum())
    centres[is_outer, face[is_outer]] = side[is_outer] * outermost
    foliage = leaves(centres * half + [0, 0, height_m / 2], shape.leaf_m, rng, shape.tint)
    stems = panel("hedge_stems", length_m, top=height_m * shape.stem_share)
    return Mesh.join([foliage, stems])


def sign_post(rng: np.random.Generator) -> Mesh:
    """Return a sign post that faces -x."""
    tints = _SHAPES.sign_tints
    return model("sign_post", tint=tuple(tints[int(rng.integers(len(tints)))]))
