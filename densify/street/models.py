# SPDX-License-Identifier: MIT
"""Make the things in the street from the shapes in models.yaml, varied at random.

The origin of a vehicle mesh is on the ground midway between the axles, x forward, z up.
"""

from __future__ import annotations

import colorsys
from collections.abc import Callable, Iterator, Mapping
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
_MIRROR = np.array([1.0, -1.0, 1.0])
WHEELBASE_M: dict[str, float] = vars(_SHAPES.wheelbase_m)
SPAN_S = (-1.0, DURATION_S + 1.0)  # times with poses
_CACHED_MODELS = 32


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
    material = fields["material"]
    fields["material"] = material if isinstance(material, Material) else Material[material]
    make, offsets = _SOLIDS[fields.pop("solid")], fields.pop("at", None)
    if "spaced" in fields:
        offsets = _spaced(fields.pop("spaced"), named)
    if offsets is None:
        return make(**fields)
    if make is box:  # many at once
        return box(**fields | {end: np.add(fields[end], offsets) for end in ("low", "high")})
    return Mesh.join([make(**fields).moved(offset) for offset in offsets])


def _spaced(row: Any, named: dict[str, Any]) -> Float:
    """Return the (N,3) offsets of solids that repeat along an axis."""
    steps = np.arange(resolve(row.first, named), resolve(row.end, named), row.step_m)
    gap_m = resolve(getattr(row, "from_middle_m", 0.0), named)
    offsets = np.zeros((np.count_nonzero(np.abs(steps) >= gap_m), 3))
    offsets[:, "xyz".index(row.axis)] = steps[np.abs(steps) >= gap_m]
    return offsets


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


def _panels(low: Float, high: Float) -> Float:
    """Return (K-1,4,3) quads between a lower and an upper line of (K,3) points."""
    return np.stack([low[:-1], low[1:], high[1:], high[:-1]], axis=1)


def _sides(low: Any, high: Any, material: Material, tint: Tint = WHITE) -> Mesh:
    """Return panels between two lines on the left, and their mirror images on the right."""
    left = _panels(np.array(low), np.array(high))
    return Mesh.quads(np.concatenate([left, left * _MIRROR]), material, tint)


def _sheet(left: Any, material: Material, tint: Tint = WHITE) -> Mesh:
    """Return a sheet from a line on the left to its mirror image on the right."""
    line = np.array(left)
    return Mesh.quads(_panels(line * _MIRROR, line), material, tint)


def _quads(corners: Any, material: Material, tint: Tint = WHITE) -> Mesh:
    return Mesh.quads(np.array(corners, float), material, tint)


_SOLIDS: dict[str, Callable[..., Mesh]] = {
    "box": box, "frustum": frustum, "tube": tube, "ball": ball,
    "sides": _sides, "sheet": _sheet, "quads": _quads,
}  # fmt: skip

# Vehicles and people


def parked_car(instance: int, rng: np.random.Generator) -> Mesh:
    """Return a car of any paint and shape."""
    return car_mesh(_any_paint(rng), rng).of_instance(instance)


def car_mesh(paint: Tint, rng: np.random.Generator) -> Mesh:
    """Return a saloon or estate, 4.2 to 4.7 m long: shell, glass, interior and wheels."""
    shape = _SHAPES.car
    style = "estate" if rng.random() < shape.estate_share else "saloon"
    front = shape.front_m + rng.uniform(*shape.longer_m)
    rear = shape.rear_m - rng.uniform(*shape.longer_m)
    roof = shape.roof_m + rng.uniform(*shape.estate_higher_m) * (style == "estate")
    named = {"front": front, "rear": rear, "roof": roof, "paint": paint, "belt": shape.belt_m}
    named |= {"wide": shape.half_width_m, "narrow": shape.roof_half_width_m}
    named |= {"cowl": shape.cowl_m, "screen": shape.screen_m}
    named["deck"] = rear + getattr(shape.deck_ahead_of_rear_m, style)
    named["rear_roof"] = rear + getattr(shape.rear_roof_ahead_of_rear_m, style)
    door_rear, door_front = shape.door_pillar_m
    for height, begin, end in (("low", "deck", "cowl"), ("high", "rear_roof", "screen")):
        behind_m, ahead_m = door_rear - named[begin], named[end] - door_front
        named[f"{height}_rear_pillar"] = named[begin] + shape.rear_pillar_share * behind_m
        named[f"{height}_front_pillar"] = named[end] - shape.front_pillar_share * ahead_m
    lights = model("car_lights", front=front, rear=rear)
    return Mesh.join([model("car_body", **named), model("car_inside"), lights])


def car(motion: Driving, instance: int, rng: np.random.Generator) -> Actor:
    """Return a driving car."""
    return Actor("car", (Body(car_mesh(_any_paint(rng), rng), motion, instance),))


def truck(motion: Driving, instance: int, rng: np.random.Generator) -> Actor:
    """Return a 16 m articulated truck. The trailer follows the tractor through turns."""
    cab = model("truck_cab", paint=_any_paint(rng))
    load = model("truck_load", tarpaulin=_any_cloth(rng))
    towed = Towed(motion, _SHAPES.truck.kingpin_m, WHEELBASE_M["trailer"], *SPAN_S)
    return Actor("truck", (Body(cab, motion, instance), Body(load, towed, instance)), num_solid=2)


def walker(motion: Driving, instance: int, rng: np.random.Generator) -> Actor:
    """Return a pedestrian: a trunk with two legs and two arms that swing in step."""
    shape = _SHAPES.walker
    hip_m = shape.hip_m + rng.uniform(*shape.taller_m)
    named = {"hip": hip_m, "foot": -(hip_m - shape.leg_shorter_than_hip_m)}
    named |= {"cloth": _any_cloth(rng), "trousers": _any_cloth(rng)}
    named["hair"] = tuple(channel * rng.random() for channel in shape.darkest_hair)
    trunk = Body(model("walker_trunk", **named), motion, instance)
    return Actor("walker", (trunk, *_limbs(shape, named, motion, instance)))


def cyclist(motion: Driving, instance: int, rng: np.random.Generator) -> Actor:
    """Return a bicycle with a rider whose legs pedal."""
    shape = _SHAPES.cyclist
    names = ("paint", "cloth", "helmet", "left_cloth", "right_cloth")
    named = {name: _any_cloth(rng) for name in names}
    wheels = [tube for x in shape.wheel.x_m for tube in _spoked_wheel(shape.wheel, x)]
    frame = Mesh.join([*wheels, model("bicycle_and_rider", **named)])
    trunk = Body(frame, motion, instance)
    return Actor("cyclist", (trunk, *_limbs(shape, named, motion, instance)))


def _limbs(shape: Any, named: dict[str, Any], motion: Driving, instance: int) -> Iterator[Body]:
    """Yield the limbs of a walker or cyclist."""
    for row in shape.limbs:
        hinge_m, phase = resolve(row.hinge_m, named), 2 * np.pi * row.phase
        limb = Limb(motion, hinge_m, row.swing_rad, shape.stride_m, phase)
        yield Body(model(row.model, **named), limb, instance)


def _spoked_wheel(row: Any, x: float) -> list[Mesh]:
    angle = np.linspace(0, 2 * np.pi, row.num_sides + 1)
    circle = row.radius_m * np.stack([np.cos(angle), 0 * angle, np.sin(angle)], axis=1)
    rim, half = circle + (x, 0, row.hub_m), row.num_sides // 2
    spokes = [(rim[i], rim[i + half]) for i in range(0, half, 2)]
    tubes = [(row.tyre_m, Material.RUBBER, ends) for ends in pairwise(rim)]
    tubes += [(row.spoke_m, Material.METAL, ends) for ends in spokes]
    return [
        tube(*ends, radius_m, material, num_sides=row.num_tube_sides)
        for radius_m, material, ends in tubes
    ]


# Houses and plants


def house(rng: np.random.Generator, width_m: float, depth_m: float) -> Mesh:
    """Return a house with its front along x, facing -y: walls, windows, door and gable roof."""
    shape = _SHAPES.house
    storeys = int(rng.integers(*shape.num_storeys))
    height = shape.storey_m * storeys + shape.attic_m
    wall = Material.BRICK if rng.random() < shape.brick_share else Material.PLASTER
    darkest, brightest = getattr(shape.tint, wall.name)
    tint = tuple(rng.uniform(darkest, brightest, 3).tolist())
    right, rear = width_m / 2, depth_m / 2
    ridge = height + rng.uniform(*shape.ridge_share) * depth_m
    named = {"height": height, "ridge": ridge, "wall": wall, "tint": tint}
    named |= {"left": -right, "right": right, "front": -rear, "rear": rear}
    named["chimney"] = float(rng.uniform(*shape.chimney_share)) * right
    windows = [
        model("house_windows", **named, sill=shape.sill_m + shape.storey_m * storey,
              beside_door=shape.beside_door_m if storey == 0 else 0.0)
        for storey in range(storeys)
    ]  # fmt: skip
    return Mesh.join([model("house_shell", **named), *windows, model("house_details", **named)])


def tree(rng: np.random.Generator) -> tuple[Mesh, Mesh]:
    """Return the mesh of a tree, and the mesh of its trunk."""
    shape = _SHAPES.tree
    height, spread = rng.uniform(*shape.height_m), rng.uniform(*shape.radius_m)
    crown = max(shape.crown_from_m, shape.crown_share * height)
    thick = shape.trunk_radius.per_m * height + shape.trunk_radius.base_m
    top = (rng.uniform(*shape.top_m), rng.uniform(*shape.top_m), height * shape.top_share)
    root = (0, 0, shape.root_m)
    trunk = tube(root, top, (thick, thick * shape.trunk_radius.top_share), Material.BARK)
    meshes = [trunk]
    for _ in range(shape.num_branches):
        angle = rng.uniform(0, 2 * np.pi)
        z = rng.uniform(crown, height * shape.branch_to_share)
        reach = spread * rng.uniform(*shape.branch_reach)
        tip = (reach * np.cos(angle), reach * np.sin(angle), z + reach * shape.branch_rise)
        start = (top[0] * z / top[2], top[1] * z / top[2], z)
        meshes.append(
            tube(start, tip, shape.branch_radius_m, Material.BARK, num_sides=shape.branch_sides)
        )
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
