# SPDX-License-Identifier: MIT
"""Make the things in the street from the shapes in models.yaml, varied at random.

The origin of a vehicle mesh is on the ground midway between the axles, x forward, z up.
"""

from __future__ import annotations

import colorsys
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import lru_cache
from itertools import pairwise
from typing import Any

import numpy as np

from densify.geometry.types import Float
from densify.street import read_table
from densify.street.mesh import WHITE, Material, Mesh, Tint, ball, box, frustum, leaves, tube
from densify.street.motion import Driving, Limb, Towed
from densify.street.world import Body

_SHAPES = read_table("models")
_MIRROR = np.array([1.0, -1.0, 1.0])
WHEELBASE_M: dict[str, float] = vars(_SHAPES.wheelbase_m)
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
def model(name: str, **parameters: Any) -> Mesh:
    """Return a mesh of models.yaml, with values (``parameters``) for the names in its rows."""
    return Mesh.join([_solid(solid, parameters) for solid in getattr(_SHAPES, name)])


def panel(name: str, length_m: float, **parameters: Any) -> Mesh:
    """Return a piece of a fence, wall or rail with this length along x, centred at the origin."""
    return model(name, left=-length_m / 2, right=length_m / 2, **parameters)


def _solid(row: Any, parameters: dict[str, Any]) -> Mesh:
    """Return the solid that a row of models.yaml describes, once or at several offsets."""
    fields = {name: resolve(value, parameters) for name, value in vars(row).items()}
    material = fields["material"]
    fields["material"] = material if isinstance(material, Material) else Material[material]
    make, offsets = _SOLIDS[fields.pop("solid")], fields.pop("at", None)
    if "spaced" in fields:
        spaced = fields.pop("spaced")
        begin_m, end_m = (resolve(end, parameters) for end in (spaced.first, spaced.end))
        along_m = np.arange(begin_m, end_m, spaced.step_m)
        gap_m = resolve(getattr(spaced, "from_middle_m", 0.0), parameters)
        axis = np.eye(3)["xyz".index(spaced.axis)]
        offsets = along_m[np.abs(along_m) >= gap_m, None] * axis
    if offsets is None:
        return make(**fields)
    if make is box:  # `box` makes many boxes at once
        return box(**fields | {end: np.add(fields[end], offsets) for end in ("low", "high")})
    solid = make(**fields)
    return Mesh.join([replace(solid, vertices=solid.vertices + offset) for offset in offsets])


def resolve(value: Any, parameters: Mapping[str, Any]) -> Any:
    """Return a value with names replaced by parameters, and [name, number] by their sum."""
    if isinstance(value, str):
        return parameters.get(value, value)
    if not isinstance(value, list):
        return value
    if len(value) == 2 and isinstance(value[0], str):
        name, beyond_m = value
        return parameters[name] + beyond_m
    return [resolve(item, parameters) for item in value]


def random_paint(rng: np.random.Generator) -> Tint:
    """Return the colour of one of the paints."""
    return tuple(_SHAPES.paints[int(rng.integers(len(_SHAPES.paints)))])


def _random_cloth(rng: np.random.Generator) -> Tint:
    """Return a random colour of cloth."""
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


_SOLIDS: dict[str, Callable[..., Mesh]] = {
    "box": box, "frustum": frustum, "tube": tube, "ball": ball,
    "sides": _sides, "sheet": _sheet, "quads": Mesh.quads,
}  # fmt: skip

# Vehicles and people


def car_mesh(paint: Tint, rng: np.random.Generator) -> Mesh:
    """Return a saloon or estate, 4.2 to 4.7 m long: shell, glass, interior and wheels."""
    shape = _SHAPES.car
    style = "estate" if rng.random() < shape.estate_share else "saloon"
    front = shape.front_m + rng.uniform(*shape.longer_m)
    rear = shape.rear_m - rng.uniform(*shape.longer_m)
    roof = shape.roof_m + rng.uniform(*shape.estate_higher_m) * (style == "estate")
    parameters = {**vars(shape.lengths), "front": front, "rear": rear, "roof": roof, "paint": paint}
    parameters["deck"] = rear + getattr(shape.deck_ahead_of_rear_m, style)
    parameters["rear_roof"] = rear + getattr(shape.rear_roof_ahead_of_rear_m, style)
    # Pillars behind and before the doors, at the lower and the upper line of the windows
    door_rear, door_front = shape.door_pillar_m
    for height, begin, end in (("low", "deck", "cowl"), ("high", "rear_roof", "screen")):
        behind_m, ahead_m = door_rear - parameters[begin], parameters[end] - door_front
        parameters[f"{height}_rear_pillar"] = parameters[begin] + shape.rear_pillar_share * behind_m
        parameters[f"{height}_front_pillar"] = parameters[end] - shape.front_pillar_share * ahead_m
    lights = model("car_lights", front=front, rear=rear)
    return Mesh.join([model("car_body", **parameters), model("car_inside"), lights])


def car(motion: Driving, instance: int, rng: np.random.Generator) -> Actor:
    """Return a driving car of random paint and shape, with this object number."""
    return Actor("car", (Body(car_mesh(random_paint(rng), rng), motion, instance),))


def truck(motion: Driving, instance: int, rng: np.random.Generator) -> Actor:
    """Return a 16 m articulated truck whose trailer follows the tractor through turns."""
    cab = model("truck_cab", paint=random_paint(rng))
    load = model("truck_load", tarpaulin=_random_cloth(rng))
    towed = Towed(motion, _SHAPES.truck.kingpin_m, WHEELBASE_M["trailer"])
    return Actor("truck", (Body(cab, motion, instance), Body(load, towed, instance)), num_solid=2)


def walker(motion: Driving, instance: int, rng: np.random.Generator) -> Actor:
    """Return a pedestrian: a trunk with two legs and two arms that swing in step."""
    shape = _SHAPES.walker
    hip_m = shape.hip_m + rng.uniform(*shape.taller_m)
    parameters = {"hip": hip_m, "foot": -(hip_m - shape.leg_shorter_than_hip_m)}
    parameters |= {"cloth": _random_cloth(rng), "trousers": _random_cloth(rng)}
    parameters["hair"] = tuple(channel * rng.random() for channel in shape.darkest_hair)
    trunk = model("walker_trunk", **parameters)
    return _with_limbs("walker", trunk, parameters, motion, instance)


def cyclist(motion: Driving, instance: int, rng: np.random.Generator) -> Actor:
    """Return a bicycle with a rider whose legs pedal."""
    names = ("paint", "cloth", "helmet", "left_cloth", "right_cloth")
    parameters = {name: _random_cloth(rng) for name in names}
    wheels = [_spoked_wheel(x_m) for x_m in _SHAPES.cyclist.wheel.x_m]
    trunk = Mesh.join([*wheels, model("bicycle_and_rider", **parameters)])
    return _with_limbs("cyclist", trunk, parameters, motion, instance)


def _with_limbs(
    name: str, trunk: Mesh, parameters: dict[str, Any], motion: Driving, instance: int
) -> Actor:
    """Return a walker or cyclist with the limbs of its row in models.yaml."""
    shape, bodies = getattr(_SHAPES, name), [Body(trunk, motion, instance)]
    for row in shape.limbs:
        hinge_m, phase = resolve(row.hinge_m, parameters), 2 * np.pi * row.phase
        limb = Limb(motion, hinge_m, row.swing_rad, shape.stride_m, phase)
        bodies.append(Body(model(row.model, **parameters), limb, instance))
    return Actor(name, tuple(bodies))


def _spoked_wheel(x_m: float) -> Mesh:
    """Return a wheel at a position along x: its tyre, and spokes across the hub."""
    row = _SHAPES.cyclist.wheel
    angle = np.linspace(0, 2 * np.pi, row.num_sides + 1)
    circle = row.radius_m * np.stack([np.cos(angle), 0 * angle, np.sin(angle)], axis=1)
    rim = circle + (x_m, 0, row.hub_m)
    half = row.num_sides // 2  # the opposite corner of the rim
    spokes = [(rim[i], rim[i + half]) for i in range(0, half, 2)]
    sides = {"num_sides": row.num_tube_sides}
    tyre = [tube(*ends, row.tyre_m, Material.RUBBER, **sides) for ends in pairwise(rim)]
    return Mesh.join(
        [*tyre, *(tube(*ends, row.spoke_m, Material.METAL, **sides) for ends in spokes)]
    )


# Houses and plants


def house(rng: np.random.Generator, width_m: float, depth_m: float) -> Mesh:
    """Return a house around the origin, ``width_m`` along x, ``depth_m`` along y, facing -y."""
    shape = _SHAPES.house
    storeys = int(rng.integers(*shape.num_storeys))
    height = shape.storey_m * storeys + shape.attic_m
    wall = Material.BRICK if rng.random() < shape.brick_share else Material.PLASTER
    darkest, brightest = getattr(shape.tint, wall.name)
    tint = tuple(rng.uniform(darkest, brightest, 3).tolist())
    right, rear = width_m / 2, depth_m / 2
    ridge = height + rng.uniform(*shape.ridge_share) * depth_m
    parameters = {"height": height, "ridge": ridge, "wall": wall, "tint": tint}
    parameters |= {"left": -right, "right": right, "front": -rear, "rear": rear}
    parameters["chimney"] = float(rng.uniform(*shape.chimney_share)) * right
    windows = [
        model("house_windows", **parameters, sill=shape.sill_m + shape.storey_m * storey,
              beside_door=shape.beside_door_m if storey == 0 else 0.0)
        for storey in range(storeys)
    ]  # fmt: skip
    return Mesh.join(
        [model("house_shell", **parameters), *windows, model("house_details", **parameters)]
    )


def tree(rng: np.random.Generator) -> tuple[Mesh, Mesh]:
    """Return the mesh of a tree, and the mesh of its foot, which vehicles must not touch."""
    shape = _SHAPES.tree
    height, spread = rng.uniform(*shape.height_m), rng.uniform(*shape.radius_m)
    crown_z = max(shape.crown_from_m, shape.crown_share * height)
    radius_m = shape.trunk_radius.per_m * height + shape.trunk_radius.base_m
    top = (rng.uniform(*shape.top_m), rng.uniform(*shape.top_m), height * shape.top_share)
    root = (0, 0, shape.root_m)
    radii_m = (radius_m, radius_m * shape.trunk_radius.top_share)
    meshes = [tube(root, top, radii_m, Material.BARK)]

    # Branches start at the trunk, between the crown's lower end and its upper part.
    for _ in range(shape.num_branches):
        angle = rng.uniform(0, 2 * np.pi)
        z = rng.uniform(crown_z, height * shape.branch_to_share)
        reach = spread * rng.uniform(*shape.branch_reach)
        tip = (reach * np.cos(angle), reach * np.sin(angle), z + reach * shape.branch_rise)
        start = (top[0] * z / top[2], top[1] * z / top[2], z)
        meshes.append(
            tube(start, tip, shape.branch_radius_m, Material.BARK, num_sides=shape.branch_sides)
        )

    # Leaves fill the outer part of an ellipsoid, scaled by 1 + depth sin(x + phase) cos(y).
    num_leaves = int(shape.leaves_per_m * spread)
    direction = rng.normal(size=(num_leaves, 3))
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    direction *= rng.uniform(shape.leaf_from, 1.0, (num_leaves, 1)) ** 0.5
    lump = shape.lump
    wave = np.sin(lump.per_x * direction[:, :1] + rng.uniform(*lump.phase))
    lumps = 1 + lump.depth * wave * np.cos(lump.per_y * direction[:, 1:2])
    middle = [top[0], top[1], (crown_z + height) / 2 + shape.crown_up_m]
    radii = [spread, spread, (height - crown_z) / 2 + shape.crown_taller_m]
    green = tuple(rng.uniform(*channel) for channel in shape.tint)
    meshes.append(leaves(middle + direction * lumps * radii, shape.leaf_m, rng, green))

    foot_radius_m = max(radius_m, shape.foot.radius_m)
    foot = tube(root, (0, 0, shape.foot.height_m), foot_radius_m, Material.BARK)
    return Mesh.join(meshes), foot


def hedge(rng: np.random.Generator, height_m: float, length_m: float) -> Mesh:
    """Return a hedge along x: dense leaves outside, a few twigs inside."""
    shape = _SHAPES.hedge
    half = np.array([length_m / 2, shape.half_depth_m, height_m / 2])
    num_leaves = int(shape.leaves_per_m2 * length_m * height_m)
    centres = rng.uniform(-1, 1, (num_leaves, 3))
    face = rng.integers(0, 3, num_leaves)
    is_outer = rng.random(num_leaves) < shape.outer_share
    # Outer leaves are moved to one of the faces of the box.
    side = np.sign(centres[np.arange(num_leaves), face])
    outermost = rng.uniform(shape.outer_from, 1.0, is_outer.sum())
    centres[is_outer, face[is_outer]] = side[is_outer] * outermost
    foliage = leaves(centres * half + [0, 0, height_m / 2], shape.leaf_m, rng, shape.tint)
    stems = panel("hedge_stems", length_m, top=height_m * shape.stem_share)
    return Mesh.join([foliage, stems])


def sign_post(rng: np.random.Generator) -> Mesh:
    """Return a sign post that faces -x."""
    tints = _SHAPES.sign_tints
    return model("sign_post", tint=tuple(tints[int(rng.integers(len(tints)))]))
