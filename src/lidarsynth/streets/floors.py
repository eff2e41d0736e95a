"""Floor plans: rooms of a building, and the walls around and between them with doors, openings and windows."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from lidarsynth.streets.shapes import Mesh, box

WALLS = ("plaster", "plaster", "plaster", "wall", "stone", "door")
SMALLEST = 2.4  # m, side of a room
OFF = 0.7  # m, from walls to the middle of what stands free
GAP = 0.12  # m, of a room's side that its wall takes, at most
GLASS = 0.1  # share of the walls between rooms
MISSING = 0.1  # share of the walls between rooms that are left out
DOOR = (0.8, 1.1, 2.05)  # m, least and most width, height


class Room(NamedTuple):
    """Metres from the building's corner."""

    x0: float
    x1: float
    y0: float
    y1: float

    @property
    def area(self) -> float:
        """Square metres."""
        return (self.x1 - self.x0) * (self.y1 - self.y0)

    def anywhere(self, rng: np.random.Generator, reach: float = OFF) -> tuple[float, float]:
        """x, y of a place `reach` metres off the sides of the walls, or more, or the middle of what is too narrow."""
        off = max(reach + GAP, OFF)
        sides = ((self.x0 + off, self.x1 - off), (self.y0 + off, self.y1 - off))
        x, y = (float(rng.uniform(a, b)) if a < b else (a + b) / 2 for a, b in sides)
        return x, y

    def beside_wall(self, rng: np.random.Generator, half: float, deep: float) -> tuple[float, float, float]:
        """x, y and yaw of something `half` as long and `deep` metres to either side that looks into the room."""
        (x, y), off, side = self.anywhere(rng, half), deep + GAP, int(rng.integers(4))
        return ((x, self.y0 + off, 0.0), (self.x1 - off, y, np.pi / 2), (x, self.y1 - off, np.pi),
                (self.x0 + off, y, -np.pi / 2))[side]  # fmt: skip


def draw_rooms(rng: np.random.Generator, length: float, width: float) -> list[Room]:
    """A rectangle cut into rooms again and again, half of the time along a corridor first."""
    whole = Room(0.0, length, 0.0, width)
    if width > 9 and rng.random() < 0.5:
        wide, middle = rng.uniform(1.5, 3.0), rng.uniform(0.35, 0.65) * width
        sides = [whole._replace(y1=middle - wide / 2), whole._replace(y0=middle + wide / 2)]
        return [whole._replace(y0=sides[0].y1, y1=sides[1].y0), *(room for side in sides for room in _cut(rng, side))]
    return _cut(rng, whole)


def _cut(rng: np.random.Generator, room: Room) -> list[Room]:
    long, wide = room.x1 - room.x0, room.y1 - room.y0
    if max(long, wide) < 2 * SMALLEST or (room.area < 60 and rng.random() < 0.35 + 0.4 * (room.area < 20)):
        return [room]
    if room.area > 60 and room.area < 250 and rng.random() < 0.12:  # an office without walls
        return [room]
    share = rng.uniform(0.3, 0.7)
    if long > wide:
        at = float(np.clip(room.x0 + share * long, room.x0 + SMALLEST, room.x1 - SMALLEST))
        return [*_cut(rng, room._replace(x1=at)), *_cut(rng, room._replace(x0=at))]
    at = float(np.clip(room.y0 + share * wide, room.y0 + SMALLEST, room.y1 - SMALLEST))
    return [*_cut(rng, room._replace(y1=at)), *_cut(rng, room._replace(y0=at))]


class Opening(NamedTuple):
    """A hole in a wall from `start` to `stop` along it and `low` to `high`, metres; filled with a material or not."""

    start: float
    stop: float
    low: float
    high: float
    pane: str = ""


def walls_between(
    rng: np.random.Generator, rooms: list[Room], size: tuple[float, float, float], windows: bool
) -> list[Mesh]:
    """All walls of a building of that length, width and height: outer ones with windows, inner ones with doors."""
    length, width, tall = size
    thick, stuff, inner = rng.uniform(0.06, 0.2), str(rng.choice(WALLS)), str(rng.choice(WALLS))
    meshes = []
    for along_x, at, stop in ((True, 0.0, length), (True, width, length), (False, 0.0, width), (False, length, width)):
        holes = _windows(rng, stop, tall) if windows else []
        meshes += wall(along_x, at, (0.0, stop), tall, thick, stuff, holes)
    glassy = rng.random() < GLASS
    for room in rooms:
        for along_x, at, edge in ((True, room.y1, width), (False, room.x1, length)):
            beside = (_shared(room, other, along_x) for other in rooms) if at < edge - 0.01 else ()
            for start, stop in filter(None, beside):
                if rng.random() >= MISSING:
                    pane = "glass" if glassy or rng.random() < GLASS / 2 else ""
                    holes = _doors(rng, start, stop, tall, pane)
                    meshes += wall(along_x, at, (start, stop), tall, thick / 2, inner, holes)
    return meshes


def _shared(room: Room, other: Room, along_x: bool) -> tuple[float, float] | None:
    """From where to where the upper or right side of a room is the lower or left one of the other."""
    if (room.y1 if along_x else room.x1) != (other.y0 if along_x else other.x0):
        return None
    mine, theirs = ((r.x0, r.x1) if along_x else (r.y0, r.y1) for r in (room, other))
    start, stop = max(mine[0], theirs[0]), min(mine[1], theirs[1])
    return (start, stop) if stop > start + 0.01 else None


def _windows(rng: np.random.Generator, stop: float, tall: float) -> list[Opening]:
    low, step = float(rng.choice([0.1, 0.8, 0.9, 1.1])), rng.uniform(1.6, 4.5)
    wide, high = step * rng.uniform(0.3, 0.85), min(tall - 0.15, low + rng.uniform(1.0, 2.0))
    starts = np.arange((step - wide) / 2, stop - wide, step)
    panes = ("glass", "glass", "glass", "window", "")
    return [
        Opening(float(s), float(s + wide), low, high, str(rng.choice(panes))) for s in starts if rng.random() < 0.85
    ]


def _doors(rng: np.random.Generator, start: float, stop: float, tall: float, pane: str) -> list[Opening]:
    """One or two doors, open or shut, or a wide opening; where the wall is of glass, panes on either side."""
    holes, place = [], start + 0.2
    for _ in range(1 + int((stop - start) > 8)):
        wide = rng.uniform(1.5, 4.0) if rng.random() < 0.15 else rng.uniform(*DOOR[:2])
        if stop - 0.2 - wide <= place:
            break
        begin = float(rng.uniform(place, max(stop - 0.2 - wide, place + 0.01)))
        if pane and begin - place > 0.3:
            holes.append(Opening(place, begin - 0.1, 0.1, min(tall, 2.3), pane))
        shut = "door" if rng.random() < 0.35 else ""
        holes.append(Opening(begin, begin + wide, 0.0, min(DOOR[2], tall - 0.05), shut))
        place = begin + wide + 0.1
    return holes


def wall(
    along_x: bool, at: float, span: tuple[float, float], tall: float, half: float, stuff: str, holes: list[Opening]
) -> list[Mesh]:
    """Boxes of a wall around its openings, which do not overlap; panes and leaves of doors stand in its middle."""
    boxes: list[tuple[float, float, float, float, float, str]] = []
    place = span[0]
    for hole in sorted(holes):
        boxes.append((place, hole.start, 0.0, tall, half, stuff))
        boxes.append((hole.start, hole.stop, 0.0, hole.low, half, stuff))
        boxes.append((hole.start, hole.stop, hole.high, tall, half, stuff))
        if hole.pane:
            boxes.append((hole.start, hole.stop, hole.low, hole.high, 0.02, hole.pane))
        place = hole.stop
    boxes.append((place, span[1], 0.0, tall, half, stuff))
    meshes = []
    for start, stop, low, high, deep, material in boxes:
        if stop - start > 1e-3 and high - low > 1e-3:
            x, y = ((start, stop), (at - deep, at + deep)) if along_x else ((at - deep, at + deep), (start, stop))
            meshes.append(box(x, y, (low, high), material, "building"))
    return meshes
