"""Insides of buildings, seen by virtual sensors on robots: rooms off corridors, halls of goods, garages.

Many small spinning LiDARs never see a road: they drive under a ceiling, between walls a metre or two away.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import partial

import numpy as np

from lidarsynth.lidar.sensor import Sensor
from lidarsynth.streets import furniture
from lidarsynth.streets.floors import Room, draw_rooms, walls_between
from lidarsynth.streets.ground import Ground, Road
from lidarsynth.streets.hdl64e import NAME
from lidarsynth.streets.objects import library
from lidarsynth.streets.reader import Worlds
from lidarsynth.streets.shapes import Mesh, box, frustum, join, moved
from lidarsynth.streets.virtual import WIDEST, VirtualSensor, VirtualStreets, draw_sensor
from lidarsynth.streets.world import POSES, STILL, THING, THINGS, World

FLOORS, CEILINGS = ("sidewalk", "parking", "wall", "road", "cloth"), ("plaster", "plaster", "wall", "sidewalk")
# Per square metre; whether with its back to a wall.
ROOMS = (("cabinet", 0.10, True), ("shelf", 0.08, True), ("sofa", 0.03, True), ("table", 0.09, False),
         ("chair", 0.16, False), ("goods", 0.05, False), ("stairs", 0.004, True))  # fmt: skip
HALLS = (("goods", 0.03), ("cabinet", 0.01), ("table", 0.008), ("stairs", 0.001))
CARS, PLACE = 0.6, 2.5  # share of a garage's places that are taken; metres from one to the next
LEVEL = 0.008  # radians, standard deviation of how robots lean
WIDE = 0.25  # share of sensors that look far up and down, as those made for robots do
TALL = {"rooms": (2.3, 3.8), "hall": (4.0, 10.0), "garage": (2.2, 3.0)}  # m, from floor to ceiling
LOWEST = 2.1  # m, above which no sensor stands
BEHIND = 60.0  # m, what lies beyond a building's windows at most
CLEAR = 0.4  # m, between a robot's middle and what stands


def interiors(seed: int = 0, length: int = 1000) -> VirtualStreets:
    """As `VirtualStreets`, but every world is a building, and the sensor stands 0.25 to 1.8 m above its floor.

    Walls and ceilings are building, floors other-ground, furniture is unlabeled, as SemanticKITTI has no words for it.
    """
    return VirtualStreets(seed, length, buildings(seed, replace(WIDEST, mount=1.0)), draw_robot)


def draw_robot(rng: np.random.Generator) -> VirtualSensor:
    """A sensor of `draw_sensor`, but for KITTI's, near the floor; a quarter of them look far up and down."""
    seen = draw_sensor(rng)
    while seen.sensor.name == NAME:
        seen = draw_sensor(rng)
    sensor = replace(seen.sensor, mount=float(rng.uniform(0.25, 1.8)), min_range=float(rng.uniform(0.1, 0.7)))
    if rng.random() < WIDE:
        top, beams = rng.uniform(15, 50), int(rng.choice([16, 32, 64, 128]))
        evenly = tuple(np.linspace(top, -rng.uniform(15, min(top, 48)), beams).tolist())
        sensor = Sensor("virtual", evenly, sensor.width, sensor.min_range, sensor.max_range, mount=sensor.mount)
        return VirtualSensor(sensor, replace(seen.optics, loss=(), dip=(), shift=()))
    return replace(seen, sensor=sensor)


def buildings(seed: int, sensor: Sensor) -> Worlds:
    """Buildings of a seed by number, whole: little of one is out of sight.

    Raises ValueError for a sensor that is not below the lowest ceiling, and for KITTI's, whose car does not fit.
    """
    if sensor.name == NAME:
        raise ValueError(f"expected a robot's sensor in buildings, such as --sensor vlp-16, found {NAME}, on its car")
    if not 0 < sensor.mount < LOWEST:
        raise ValueError(f"sensor {sensor.name}: expected a mount of 0 to {LOWEST:g} m in buildings, below their "
                         f"ceilings, found {sensor.mount:g}")  # fmt: skip
    return Worlds(seed, sensor, built=partial(_numbered, seed))


def _numbered(seed: int, number: int) -> World:
    return building(np.random.default_rng((seed, number, 6)))


@dataclass
class Site:
    """What is placed in a building, in order.

    taken   (x, y, reach) of what stands, which robots keep clear of
    things  of the library: number of its mesh, kind, variant, row as `builder.ROW`
    """

    rng: np.random.Generator
    meshes: list[Mesh] = field(default_factory=list)
    tints: list[float] = field(default_factory=list)
    taken: list[tuple[float, float, float]] = field(default_factory=list)
    things: list[tuple[int, str, int, tuple[float, ...]]] = field(default_factory=list)

    def put(self, shape: Mesh) -> None:
        """A mesh where it belongs, of a tint of its own."""
        self.meshes.append(shape)
        self.tints.append(float(np.clip(self.rng.normal(), -1.5, 2.2)))

    def stand(self, shape: Mesh, x: float, y: float, yaw: float, beside: float | None = None) -> bool:
        """A mesh around its own middle, if nothing stands there yet; what is `beside` it may be as near, in metres."""
        reach = float(np.abs(shape.corners[..., :2]).max())
        if any(np.hypot(x - a, y - b) < (0.7 * (reach + r) if beside is None else beside) for a, b, r in self.taken):
            return False
        self.put(moved(shape, x, y, yaw=yaw))
        self.taken.append((x, y, reach))
        return True


def building(rng: np.random.Generator) -> World:
    """One building. The same generator state gives the same one."""
    site, draw = Site(rng), rng.random()
    kind = "rooms" if draw < 0.55 else "hall" if draw < 0.8 else "garage"
    tall = float(rng.uniform(*TALL[kind]))
    size = {"rooms": ((9, 45), (6, 25)), "hall": ((18, 80), (12, 45)), "garage": ((20, 70), (16, 40))}[kind]
    length, width = (float(rng.uniform(*bounds)) for bounds in size)
    rooms = draw_rooms(rng, length, width) if kind == "rooms" else [Room(0.0, length, 0.0, width)]
    _shell(site, rooms, (length, width, tall), kind)
    for room in rooms:
        _under_ceiling(site, room, tall)
        {"rooms": _furnish, "hall": _stock, "garage": _park}[kind](site, room, tall)
    return _world(site, _poses(rng, rooms, site.taken))


def _shell(site: Site, rooms: list[Room], size: tuple[float, float, float], kind: str) -> None:
    """Floor, ceiling, outer walls with windows, walls between rooms with doors, and what one sees through windows."""
    rng, (length, width, tall) = site.rng, size
    site.put(box((-BEHIND, length + BEHIND), (-BEHIND, width + BEHIND), (-0.7, -0.4), "road", "road"))
    site.put(box((0, length), (0, width), (-0.3, 0.0), str(rng.choice(FLOORS)), "other-ground"))
    site.put(box((0, length), (0, width), (tall, tall + 0.3), str(rng.choice(CEILINGS)), "building"))
    if rng.random() < 0.5:
        away = rng.uniform(6, 30)
        site.put(box((-5, length + 5), (-away - 8, -away), (-0.5, rng.uniform(4, 12)), "plaster", "building"))
    for shape in walls_between(rng, rooms, size, windows=kind == "rooms" or rng.random() < 0.3):
        site.put(shape)


def _under_ceiling(site: Site, room: Room, tall: float) -> None:
    """Lamps, joists and pipes."""
    rng, draw = site.rng, site.rng.random(3)
    if draw[0] < 0.6:
        step, size = rng.uniform(1.8, 4.0), (rng.uniform(0.1, 0.6), rng.uniform(0.6, 1.4))
        for x in np.arange(room.x0 + step / 2, room.x1 - size[0] - 0.1, step):
            for y in np.arange(room.y0 + step / 2, room.y1 - size[1] - 0.1, step):
                site.put(box((x, x + size[0]), (y, y + size[1]), (tall - 0.08, tall), "lamp", "unlabeled"))
    if draw[1] < (0.3 if tall < 4 else 0.8):
        deep, step = rng.uniform(0.15, 0.6), rng.uniform(2.0, 7.0)
        for x in np.arange(room.x0 + step / 2, room.x1, step):
            site.put(box((x, x + rng.uniform(0.1, 0.4)), (room.y0, room.y1), (tall - deep, tall), "wall", "building"))
    if draw[2] < 0.4:
        for _ in range(int(rng.integers(1, 4))):
            thick, drop = rng.uniform(0.05, 0.5), rng.uniform(0.0, 0.3)
            y = rng.uniform(room.y0, max(room.y1 - thick, room.y0 + 0.01))
            high = tall - drop
            site.put(box((room.x0, room.x1), (y, y + thick), (high - thick, high), "sign back", "unlabeled"))


def _spots(site: Site, room: Room, count: int, shape_of: str, beside_walls: bool) -> None:
    """Furniture of a kind anyhow in the room, or with its back to a wall."""
    rng = site.rng
    for _ in range(count):
        shape = furniture.KINDS[shape_of](rng)
        flat = shape.corners[..., :2]
        if beside_walls:
            x, y, yaw = room.beside_wall(rng, *(float(np.abs(flat[..., axis]).max()) for axis in (0, 1)))
        else:
            x, y, yaw = *room.anywhere(rng, float(np.hypot(*flat.reshape(-1, 2).T).max())), rng.uniform(0, 6.28)
        site.stand(shape, x, y, yaw)


def _furnish(site: Site, room: Room, tall: float) -> None:
    """A room that people live or work in: full, half empty, or a corridor with little in it."""
    rng, area = site.rng, room.area
    full = 0.3 if min(room.x1 - room.x0, room.y1 - room.y0) < 2.6 else rng.choice([0.2, 0.7, 1.0, 1.6])
    for kind, per, beside in ROOMS:
        _spots(site, room, min(int(rng.poisson(per * full * area)), 40), kind, beside)
    _people(site, room, rng.poisson(min(0.02 * area, 4)))
    if rng.random() < 0.25:
        _plants(site, room, int(rng.integers(1, 4)))


def _stock(site: Site, room: Room, tall: float) -> None:
    """A hall: racks in rows or machines, pillars where there is room, goods, people, now and then a van."""
    rng = site.rng
    if rng.random() < 0.6:
        middle = (room.x0 + room.x1) / 2
        aisle, bays = rng.uniform(2.8, 5.0), max(1, int((room.x1 - room.x0 - rng.uniform(4, 10)) / 2.7))
        for y in np.arange(room.y0 + aisle, room.y1 - 1.5, aisle + 1.2):
            high = min(tall - 1.8, rng.uniform(2, 7))  # and what lies on top
            site.put(moved(furniture.rack(rng, bays, high), middle, float(y)))
            site.taken += [
                (float(x), float(y), 0.7) for x in np.arange(middle - 1.35 * bays, middle + 1.35 * bays, 0.7)
            ]
    _pillars(site, room, tall, rng.uniform(5, 14), float(rng.choice([0.0, 0.15, 0.3])))
    for kind, per in HALLS:
        _spots(site, room, min(int(rng.poisson(per * room.area)), 60), kind, False)
    _spots(site, room, int(rng.integers(0, 20)), "shelf", True)
    _people(site, room, rng.poisson(3))
    if rng.random() < 0.3:
        _of_library(site, str(rng.choice(["van", "car"])), *room.anywhere(rng, 2.5), yaw=rng.uniform(0, 6.28))


def _park(site: Site, room: Room, tall: float) -> None:
    """A garage: pillars, cars in rows of places, some of them empty."""
    rng, lane = site.rng, site.rng.uniform(5.5, 7.5)
    _pillars(site, room, tall, rng.uniform(5, 8.5), rng.uniform(0.2, 0.5))
    for y in np.arange(room.y0 + 2.7, room.y1 - 2.5, lane + 5.0):
        for row in (float(y), float(y) + lane):
            for x in np.arange(room.x0 + 1.6, room.x1 - 1.5, PLACE):
                if rng.random() < CARS and row < room.y1 - 2.4:
                    yaw = np.pi / 2 * rng.choice([-1, 1]) + rng.normal(0, 0.02)
                    _of_library(site, "car", float(x), row, yaw, beside=0.9 * PLACE)
    _people(site, room, rng.poisson(1))


def _pillars(site: Site, room: Room, tall: float, step: float, thick: float) -> None:
    if thick <= 0:
        return
    round_ = site.rng.random() < 0.3
    for x in np.arange(room.x0 + step, room.x1 - 1.0, step):
        for y in np.arange(room.y0 + step, room.y1 - 1.0, step):
            square = box((-thick, thick), (-thick, thick), (0, tall), "wall", "building")
            shape = frustum((thick, thick), (0, tall), 14, "plaster", "building") if round_ else square
            site.stand(shape, float(x), float(y), 0.0)


def _of_library(
    site: Site, kind: str, x: float, y: float, yaw: float, size: float = 1.0, beside: float | None = None
) -> None:
    """One of the things that streets have, too, of any variant, where there is room for it."""
    variant = int(site.rng.integers(len(library()[kind])))
    shape = library()[kind][variant]
    if site.stand(replace(shape, corners=shape.corners * np.float32(size)), x, y, yaw, beside):
        row = (x, y, 0.0, yaw, size, size, size, site.tints[-1])
        site.things.append((len(site.meshes) - 1, kind, variant, row))


def _people(site: Site, room: Room, count: int) -> None:
    for _ in range(count):
        _of_library(site, "person", *room.anywhere(site.rng), yaw=site.rng.uniform(0, 6.28))


def _plants(site: Site, room: Room, count: int) -> None:
    for _ in range(count):
        _of_library(site, "bush", *room.anywhere(site.rng), yaw=0.0, size=float(site.rng.uniform(0.3, 0.8)))


def _poses(rng: np.random.Generator, rooms: list[Room], taken: list[tuple[float, float, float]]) -> np.ndarray:
    """(16, 6) x, y, z, yaw, pitch, roll of robots that stand clear of all else, in larger rooms more often."""
    weights = np.array([room.area for room in rooms])
    spots = np.array(taken) if taken else np.full((1, 3), -1e3)
    poses = np.zeros((POSES, 6))
    for pose in poses:
        best = -np.inf
        for _ in range(40):
            x, y = rooms[rng.choice(len(rooms), p=weights / weights.sum())].anywhere(rng)
            gap = float((np.hypot(spots[:, 0] - x, spots[:, 1] - y) - 0.8 * spots[:, 2]).min())
            if gap > best:
                best, pose[:2] = gap, (x, y)
            if best > CLEAR:
                break
        pose[3:] = rng.uniform(0, 2 * np.pi), *rng.normal(0, LEVEL, 2)
    return poses


def _world(site: Site, poses: np.ndarray) -> World:
    """One soup of all that was put."""
    soup, sizes = join(*site.meshes), [len(shape) for shape in site.meshes]
    thing_of = np.full(len(sizes), -1, np.int32)
    thing_of[[mesh for mesh, *_ in site.things]] = np.arange(len(site.things))
    return World(
        **vars(soup),
        kind=np.full(len(soup), THING, np.uint8),
        tint=np.repeat(site.tints, sizes).astype(np.float32),
        front=np.full(len(soup), -1, np.int16),
        fronts=np.zeros((0, 12), np.float32),
        ground=Ground((Road(0, 0, 0, 3.0, 0.0),)),
        poses=poses,
        thing=np.repeat(thing_of, sizes),
        things=np.array([(kind, variant, row, STILL) for _, kind, variant, row in site.things], THINGS),
    )
