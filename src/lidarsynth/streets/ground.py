"""Roads and the ground beneath them: centre lines, heights, and what the surface is made of at any point."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from lidarsynth.lidar.semantic_kitti import CLASS_NUMBER
from lidarsynth.streets.materials import NUMBER

KERB = 0.12  # metres from carriageway to sidewalk, unless said otherwise
CROWN = 0.018  # fall of a carriageway from its middle to its edges
BUMPS = (0.006, 0.014)  # metres, unevenness of paved and of other ground
BESIDE = 0.06  # metres beyond the carriageway's edge that its markings may reach


@dataclass(frozen=True)
class Road:
    """A road along a gently waving centre line; s runs along it, d to its left, both in metres."""

    x: float
    y: float
    yaw: float  # direction of s, radians
    half: float  # half width of the carriageway, parking lanes included
    walk: float  # width of each sidewalk, 0 for none
    parking: tuple[float, float] = (0.0, 0.0)  # width of the parking lanes right and left
    wave: tuple[float, float, float] = (0.0, 100.0, 0.0)  # amplitude (m), wave length (m), phase of the bend
    start: float = -150.0  # range of s that exists
    stop: float = 150.0
    lanes: str = "none"  # centre marking: none, dashed or solid
    rails: bool = False
    paved: bool = True  # False: a gravel track

    def bend(self, s: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Sideways shift (m) and slope of the centre line at s."""
        size, length, phase = self.wave
        k = 2 * np.pi / length
        angle = k * s + phase
        return size * (np.sin(angle) - float(np.sin(phase))), size * k * np.cos(angle)

    def at(self, s: np.ndarray, d: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """World x, y and direction (radians) of the point at (s, d)."""
        shift, slope = self.bend(s)
        turn = np.arctan(slope)
        u, v = s - d * np.sin(turn), shift + d * np.cos(turn)
        c, sn = np.cos(self.yaw), np.sin(self.yaw)
        return self.x + c * u - sn * v, self.y + sn * u + c * v, self.yaw + turn

    def coordinates(self, x: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """(s, d) of world points; d is infinite beyond the road's ends. One Newton step to the bend: 2 cm."""
        u, v = self._endless(x, y)
        return u, np.where((u >= self.start) & (u <= self.stop), v, np.inf)

    def _endless(self, x: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """(s, d) of world points, as if the road had no ends."""
        c, sn = np.float32(np.cos(self.yaw)), np.float32(np.sin(self.yaw))
        east, north = x - np.float32(self.x), y - np.float32(self.y)
        u, v = c * east + sn * north, c * north - sn * east
        if self.wave[0] != 0:
            shift, slope = self.bend(u)
            foot = u + (v - shift) * slope / (1 + slope**2)
            shift, slope = self.bend(foot)
            v = ((v - shift) - (u - foot) * slope) / np.sqrt(1 + slope**2)
            u = foot
        return u, v

    def within(self, x: np.ndarray, y: np.ndarray, reach: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Which of N world points, by number, lie less than `reach` m beside the road, and their (s, d)."""
        if self.wave[0] != 0:
            s, d = self._endless(x, y)
            near = np.flatnonzero(np.abs(d) < reach)
            s, d = s.take(near), d.take(near)
        else:
            c, sn = np.float32(np.cos(self.yaw)), np.float32(np.sin(self.yaw))
            near = np.flatnonzero(np.abs(c * (y - np.float32(self.y)) - sn * (x - np.float32(self.x))) < reach)
            s, d = self._endless(x.take(near), y.take(near))
        there = (s >= self.start) & (s <= self.stop)
        return (near, s, d) if there.all() else (near.compress(there), s.compress(there), d.compress(there))


@dataclass(frozen=True)
class Ground:
    """Height and surface of the world. `verge` is the material word beside the roads: grass, gravel or sidewalk."""

    roads: tuple[Road, ...]
    slope: tuple[float, float] = (0.0, 0.0)  # along x and y
    hills: np.ndarray = field(default_factory=lambda: np.zeros((0, 4), np.float32))  # amplitude, kx, ky, phase
    banks: tuple[float, float] = (0.0, 0.0)  # slope of the land right and left of the first road
    verge: str = "grass"
    patches: np.ndarray = field(default_factory=lambda: np.zeros((4, 3), np.float32))  # kx, ky, phase of wear
    phase: float = 0.0  # where the dashes of markings start
    kerb: float = KERB  # metres from carriageway to sidewalk

    def height(self, x: np.ndarray, y: np.ndarray) -> np.ndarray:
        """Metres above the origin of the bare ground, carriageway level."""
        z = self.slope[0] * x + self.slope[1] * y
        for amplitude, kx, ky, phase in self.hills:
            z = z + amplitude * np.sin(kx * x + ky * y + phase)
        if self.banks != (0.0, 0.0):
            road = self.roads[0]
            _, d = road.coordinates(x, y)
            d = np.where(np.isfinite(d), d, 0)
            far = np.clip(np.abs(d) - road.half - road.walk - 3.0, 0, 14)
            z = z + far * np.where(d > 0, self.banks[1], self.banks[0])
        return z

    def carriageway(self, x: np.ndarray, y: np.ndarray, skip: int = -1) -> np.ndarray:
        """Metres to the nearest carriageway's edge, negative on it; road number `skip` is not counted."""
        gap = np.full(np.shape(x), np.inf)
        for i, road in enumerate(self.roads):
            if i != skip:
                gap = np.minimum(gap, np.abs(road.coordinates(x, y)[1]) - road.half)
        return gap

    def surface(self, x: np.ndarray, y: np.ndarray, raised: np.ndarray) -> tuple[np.ndarray, ...]:
        """What the ground is made of at world points x, y (N,).

        raised (N,) bool: the beam met a sidewalk slab. Returns material (N,), label (N,) uint8, the change of signal by
        wear (N,) float32, and how far the real surface lies below the smooth one (N,) float32 metres: crown and bumps.
        """
        material = np.full(x.shape, NUMBER[self.verge], np.uint8)
        label = np.full(x.shape, CLASS_NUMBER["sidewalk" if self.verge == "sidewalk" else "terrain"], np.uint8)
        sag, tracks = np.zeros(x.shape, np.float32), np.zeros(x.shape, np.float32)
        roadway = np.zeros(x.shape, bool)
        for road in self.roads:
            near, s, d = road.within(x, y, road.half + BESIDE)
            on = np.abs(d) < road.half
            inside, across = near.compress(on), d.compress(on)
            roadway[inside] = True
            sag[inside] = CROWN * np.abs(across)
            tracks[inside] = 1.6 * np.cos(4 * np.pi * across / road.half + self.phase)  # two wheels a lane
            material[inside] = NUMBER["road" if road.paved else "gravel"]
            label[inside] = CLASS_NUMBER["road"]
            if max(road.parking) > 0:
                park = inside.compress((across < road.parking[0] - road.half) | (across > road.half - road.parking[1]))
                material[park], label[park] = NUMBER["parking"], CLASS_NUMBER["parking"]
            for name, spots in self._paint(road, s, d):
                material[near.take(spots)] = NUMBER[name]
        material[raised], label[raised] = NUMBER["sidewalk"], CLASS_NUMBER["sidewalk"]
        wear = tracks.copy()
        for kx, ky, phase in self.patches:
            wear += np.sin(kx * x + ky * y + phase)
        uneven = BUMPS[0] if self.verge == "sidewalk" else BUMPS[1]
        sag[raised] = 0
        bumps = np.where(roadway | raised, np.float32(BUMPS[0]), np.float32(uneven)) * (wear - tracks)
        return material, label, np.float32(0.012) * wear, sag + bumps

    def _paint(self, road: Road, s: np.ndarray, d: np.ndarray) -> list[tuple[str, np.ndarray]]:
        """Lane markings, stop lines and rails: the material's word and which of the points (s, d) it covers."""
        width = np.float32(0.075)
        right, left = road.half - road.parking[0], road.half - road.parking[1]
        middle = np.float32((left - right) / 2)
        line = np.zeros(s.shape, bool)
        if road.lanes != "none":
            line |= np.abs(d - middle) < width
            if road.lanes == "dashed":
                line &= (s + self.phase) / 9 - np.floor((s + self.phase) / 9) < 0.44
            line |= (np.abs(d - left + 0.25) < width) | (np.abs(d + right - 0.25) < width)
        elif max(road.parking) > 0:
            line |= (np.abs(d - left) < 0.05) | (np.abs(d + right) < 0.05)
        painted = np.flatnonzero(line)
        for other in self.roads:  # no lines across a crossing
            if other is not road and len(painted):
                x, y, _ = road.at(s[painted], d[painted])
                painted = painted[np.abs(other.coordinates(x, y)[1]) >= other.half + 1.0]
        found = [("marking", painted)]
        if road.rails:
            for centre in (-1.6, 1.6):
                found.append(("rail", np.flatnonzero(np.abs(np.abs(d - np.float32(centre)) - 0.72) < 0.06)))
        return found


def ground_mesh(ground: Ground, reach: tuple[float, float], cell: float) -> np.ndarray:
    """(T, 3, 3) float32: the bare ground as a grid of `cell` metres over +-reach (x, y)."""
    xs = np.arange(-reach[0], reach[0] + cell, cell, dtype=np.float32)
    ys = np.arange(-reach[1], reach[1] + cell, cell, dtype=np.float32)
    x, y = np.meshgrid(xs, ys, indexing="ij")
    p = np.stack([x, y, ground.height(x, y)], axis=-1).astype(np.float32)
    quad = np.stack([p[:-1, :-1], p[1:, :-1], p[1:, 1:], p[:-1, 1:]], axis=-2).reshape(-1, 4, 3)
    return quad[:, [[0, 1, 2], [0, 2, 3]]].reshape(-1, 3, 3)


def slab_mesh(ground: Ground, step: float = 2.5) -> tuple[np.ndarray, np.ndarray]:
    """Sidewalks of all roads as raised strips. Returns (T, 3, 3) float32 and (T,) bool, True for kerb faces."""
    parts, kerbs = [], []
    for i, road in enumerate(ground.roads):
        if road.walk <= 0:
            continue
        s = np.arange(road.start, road.stop, step)
        profile = ((road.half, 0.0), (road.half, ground.kerb), (road.half + road.walk, ground.kerb))
        along = np.tile(s, (2, 3, 2, 1))  # sides, profile, both ends of a piece
        along[:, :, 1] += step
        across = np.array([[side * d for d, _ in profile] for side in (-1, 1)])[..., None, None]
        x, y, _ = road.at(along, np.broadcast_to(across, along.shape))
        z = ground.height(x, y) + np.array([up for _, up in profile])[:, None, None]
        edges = np.stack([x, y, z], axis=-1)
        for side, edge in zip((-1, 1), edges, strict=True):
            (low_a, low_b), (a, c), (b, e) = edge
            x, y, _ = road.at(s + step / 2, np.full(s.shape, side * (road.half + 0.2)))
            open_ = ground.carriageway(x, y, skip=i) > 0.1
            for quad, kerb in ((np.stack([a, b, e, c], 1), False), (np.stack([low_a, a, c, low_b], 1), True)):
                triangles = quad[open_][:, [[0, 1, 2], [0, 2, 3]]].reshape(-1, 3, 3)
                parts.append(triangles)
                kerbs.append(np.full(len(triangles), kerb))
    if not parts:
        return np.zeros((0, 3, 3), np.float32), np.zeros(0, bool)
    return np.concatenate(parts).astype(np.float32), np.concatenate(kerbs)
