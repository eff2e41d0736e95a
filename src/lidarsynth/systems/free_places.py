"""Where there is room in a recorded scan for one road user more: on ground that was seen, and where nothing stands."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np

from lidarsynth.lidar.removal import GROUND
from lidarsynth.lidar.semantic_kitti import CLASS_NUMBER
from lidarsynth.streets.actors import MARGIN
from lidarsynth.streets.apart import CARRIER, footprints, meet
from lidarsynth.streets.shapes import Mesh


class Room(NamedTuple):
    """Where things of a kind may stand: on which ground, how many metres from the sensor, in the street's direction or
    in any."""

    ground: tuple[str, ...]
    far: float
    along: bool


_LANES = Room(("road",), 50.0, True)
ROOMS = {
    "car": Room(("road", "parking"), 40.0, True),
    "van": Room(("road", "parking"), 40.0, True),
    **dict.fromkeys(("truck", "bus", "lorry", "coach", "trailer"), _LANES),
    "bicyclist": _LANES._replace(far=30.0),
    "motorcyclist": _LANES._replace(far=35.0),
    "person": Room(GROUND, 25.0, False),
    "bicycle": Room(GROUND[:4], 20.0, False),
    "motorcycle": Room(GROUND[:4], 25.0, False),
}
NEAR = 3.0  # metres between the sensor and whatever is put: its carrier's own
CELL, TRIES = 0.5, 300  # metres: places are drawn evenly from such cells of ground that was seen; so many are looked at
SIDE = 1 << 16  # cells to each side, from the first to the last
WIDE, FEW = (4.0, 8.0), 12  # metres around a place whose ground tells its plane, the nearer if it has so many returns
SPREAD = 1.0  # and these spread as far in every direction, metres: those of a single ring hardly tell how it rises
STEEP = 0.3  # of a plane: what is steeper is no ground
LOW, OVER = 0.3, 0.2  # metres above the ground, and above a thing, between which nothing may return
GAP, SEEN, MOST = 0.3, 0.8, 0.2  # metres around a thing that are free; that must show ground; of it, of another kind
STREET, ASKEW = 15.0, 0.04  # metres around a place that tell how its street runs; radians, off which things stand
LANE = 1.75  # metres to the left of the sensor, up to where traffic goes its way: on the right, as in most countries


class Spot(NamedTuple):
    """A place: x, y and the ground's height, metres of a frame that stands upright, the sensor at its origin; yaw,
    radians; by how much the ground rises along x and y."""

    x: float
    y: float
    z: float
    yaw: float
    slope: tuple[float, float]

    def on_ground(self, mesh: Mesh) -> Mesh:
        """A mesh of its own frame, 0 on the ground, as it stands here: upright, and lifted as the ground is."""
        c, s = np.cos(self.yaw), np.sin(self.yaw)
        x, y, z = np.moveaxis(mesh.corners, -1, 0)
        aside, ahead = s * x + c * y, c * x - s * y
        lifted = self.z + z + self.slope[0] * ahead + self.slope[1] * aside
        corners = np.stack([self.x + ahead, self.y + aside, lifted], -1).astype(np.float32)
        return Mesh(corners, mesh.material, mesh.label)


@dataclass
class Surroundings:
    """Points (N, 3), metres of a frame that stands upright, and their classes (N,); `axis`, radians, in which direction
    most of what stands does, or None; `taken`, footprints (5,) of `streets.apart` where things have been put."""

    points: np.ndarray
    label: np.ndarray
    axis: float | None
    taken: list[np.ndarray] = field(default_factory=list)

    def spot(self, x: float, y: float, yaw: float) -> Spot | None:
        """The place with its ground, None where too little of it was seen."""
        dx, dy = self.points[:, 0] - x, self.points[:, 1] - y
        away, flat = dx * dx + dy * dy, np.isin(self.label, _numbers(GROUND))
        for wide in WIDE:
            at = flat & (away < wide * wide)
            if at.sum() >= FEW and (wide == WIDE[-1] or _spread(dx[at], dy[at]) >= SPREAD):
                z, ahead, aside = _plane(dx[at], dy[at], self.points[at, 2])
                return Spot(x, y, z, yaw, (ahead, aside)) if np.hypot(ahead, aside) < STEEP else None
        return None

    def footprint(self, spot: Spot, mesh: Mesh) -> np.ndarray:
        """(5,) of a thing at a place."""
        flat = mesh.corners.reshape(-1, 3)[:, :2]
        low, high = flat.min(0), flat.max(0)
        place = np.array([spot.x, spot.y])
        return footprints(place, np.array(spot.yaw), (low + high) / 2, (high - low) / 2 + MARGIN)

    def crowded(self, spot: Spot, mesh: Mesh) -> bool:
        """Whether a thing would stand in one that was put before, or in the sensor."""
        own = self.footprint(spot, mesh)
        if np.hypot(spot.x, spot.y) < NEAR or meet(own, np.array([0.0, 0.0, 0.0, *CARRIER])):
            return True
        return bool(len(self.taken) and meet(own, np.stack(self.taken)).any())

    def in_it(self, spot: Spot, mesh: Mesh, gap: float = 0.0) -> np.ndarray:
        """(N,) bool: which points are above the ground where a thing would stand, or `gap` metres beside it."""
        x, y, _, half, width = self.footprint(spot, mesh)
        dx, dy = self.points[:, 0] - spot.x, self.points[:, 1] - spot.y
        height = self.points[:, 2] - spot.z - spot.slope[0] * dx - spot.slope[1] * dy
        tall = float(mesh.corners[..., 2].max()) + OVER
        return self._beside(x, y, spot.yaw, half + gap, width + gap) & (height > LOW) & (height < tall)

    def ground_of(self, spot: Spot, mesh: Mesh, words: tuple[str, ...]) -> tuple[int, int]:
        """How many returns of the ground there are at a thing, and how many of these are of such ground."""
        x, y, _, half, width = self.footprint(spot, mesh)
        label = self.label[self._beside(x, y, spot.yaw, half + SEEN, width + SEEN)]
        return int(np.isin(label, _numbers(GROUND)).sum()), int(np.isin(label, _numbers(words)).sum())

    def _beside(self, x: float, y: float, yaw: float, half: float, width: float) -> np.ndarray:
        c, s = np.cos(yaw), np.sin(yaw)
        dx, dy = self.points[:, 0] - x, self.points[:, 1] - y
        return (np.abs(c * dx + s * dy) < half) & (np.abs(c * dy - s * dx) < width)

    def heading(self, x: float, y: float, words: tuple[str, ...], rng: np.random.Generator) -> float:
        """Radians: in which direction the street runs at a place, and traffic there."""
        ground = self.points[np.isin(self.label, _numbers(words)), :2] - [x, y]
        cells = _cells(ground[np.abs(ground).max(1) < STREET]) * CELL
        if len(cells) < FEW:
            return float(rng.uniform(-np.pi, np.pi))
        yaw = self.axis
        if yaw is None:
            way = np.linalg.eigh(np.cov(cells.T))[1][:, 1]
            yaw = float(np.arctan2(way[1], way[0]))
        along, aside = (np.abs(cells @ [np.cos(turn), np.sin(turn)]).mean() for turn in (yaw, yaw + np.pi / 2))
        yaw = yaw if along >= aside else yaw + np.pi / 2
        back = bool(rng.random() < 0.5) if abs(np.cos(yaw)) < 0.7 else (np.cos(yaw) > 0) != (y < LANE)
        return yaw + np.pi * back + float(rng.normal(0, ASKEW))

    def free(self, kind: str, mesh: Mesh, rng: np.random.Generator) -> Iterator[Spot]:
        """Places for a thing, drawn one after the other from all where points tell that there is room."""
        room = ROOMS[kind]
        ground = self.points[np.isin(self.label, _numbers(room.ground)), :2]
        away = np.hypot(*ground.T)
        cells = _cells(ground[(away > NEAR) & (away < room.far)])
        for x, y in (rng.permutation(cells)[:TRIES] + rng.uniform(-0.5, 0.5, (min(len(cells), TRIES), 2))) * CELL:
            yaw = self.heading(x, y, room.ground, rng) if room.along else float(rng.uniform(-np.pi, np.pi))
            spot = self.spot(float(x), float(y), yaw)
            if spot is None or self.crowded(spot, mesh) or self.in_it(spot, mesh, GAP).any():
                continue
            flat, right = self.ground_of(spot, mesh, room.ground)
            if right and flat - right <= MOST * flat:
                yield spot


def _cells(places: np.ndarray) -> np.ndarray:
    """(M, 2) cells of places (N, 2), less than a kilometre away, each once and in order."""
    x, y = np.round(places / CELL).astype(np.int64).T
    return np.stack(np.divmod(np.unique(x * SIDE + y + SIDE // 2), SIDE), 1) - [0, SIDE // 2]


def _numbers(words: tuple[str, ...]) -> list[int]:
    return [CLASS_NUMBER[word] for word in words]


def _spread(x: np.ndarray, y: np.ndarray) -> float:
    """Metres, the standard deviation of the points (n,) in the direction in which it is least."""
    return float(np.sqrt(np.linalg.eigvalsh(np.cov(x, y))[0].clip(0)))


def _plane(x: np.ndarray, y: np.ndarray, z: np.ndarray) -> list[float]:
    """Height at the origin and slopes of the plane through most of the points (n,)."""
    known, weight = np.stack([np.ones_like(x), x, y], 1).astype(np.float64), np.ones(len(x))
    fitted = np.zeros(3)
    for _ in range(4):
        fitted = np.linalg.lstsq(known * weight[:, None], z * weight, rcond=None)[0]
        off = np.abs(z - known @ fitted)
        weight = 1 / np.maximum(off, max(1.5 * float(np.median(off)), 0.01)) ** 0.5
    return fitted.tolist()
