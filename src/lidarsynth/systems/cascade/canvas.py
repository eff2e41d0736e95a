"""A generated scan on which things of the streets are cast: what is seen where, what a thing brings back, what is set
in its place."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np

from lidarsynth.lidar.boxes import Box, counted
from lidarsynth.lidar.pieces import connected
from lidarsynth.lidar.scan import RangeImage
from lidarsynth.lidar.semantic_kitti import CLASS_NUMBER
from lidarsynth.lidar.sensor import Sensor
from lidarsynth.streets.actors import MARGIN
from lidarsynth.streets.hdl64e import Lasers, hidden, lasers
from lidarsynth.streets.lone import alone
from lidarsynth.streets.materials import MATERIALS
from lidarsynth.streets.raycast import FewTriangles
from lidarsynth.streets.sensor_model import RESPONSE, Returns, sense
from lidarsynth.streets.shapes import Mesh
from lidarsynth.streets.turn import sensor_pose
from lidarsynth.systems.cascade.hanging import beside

GROUND = np.isin(np.arange(len(CLASS_NUMBER)), [CLASS_NUMBER[w] for w in ("road", "parking", "sidewalk", "terrain")])
STANDING = np.array([CLASS_NUMBER[w] for w in ("building", "fence", "car")])
# Columns, and metres between their returns, that tell in which direction something stands.
ALONG, APART = 3, (0.05, 1.5)
# Metres of a cell; returns of one thing are less than so many cells from others; and so many are enough for one.
CELL, REACH, FEW = 0.4, 4, 20
AROUND = 6.0  # metres around a thing where the ground is looked for
SIZE = (0.97, 1.03)  # things are so much smaller or larger than the streets'
OCCLUDED = 0.3  # metres nearer than a thing that hide it
TINT = (-1.0, 2.2)  # in spreads of the material: the darkest would not return


@dataclass
class Canvas:
    """A scan in the making: metres (H, W), 0 for no return, reflectance, label; points (H, W, 3), rays (H, W, 3) and
    where these start, (H, 3), of a frame that stands upright; their azimuth and elevation, (H, W) radians.

    `at` (N,) are places in the flattened image.
    """

    sensor: Sensor
    metres: np.ndarray
    reflectance: np.ndarray
    label: np.ndarray
    points: np.ndarray
    rays: np.ndarray
    starts: np.ndarray
    azimuth: np.ndarray
    elevation: np.ndarray
    instance: np.ndarray  # (H, W) int32: which of `boxes`, from 1 on, a return is of
    boxes: list[Box] = field(default_factory=list)  # of what was cast, in the sensor's frame
    taken: list[np.ndarray] = field(default_factory=list)  # where these stand, as `streets.apart.footprints`

    @cached_property
    def reach(self) -> tuple[np.ndarray, np.ndarray]:
        """Least and greatest elevation of each beam's rays, (H,) radians."""
        return self.elevation.min(1), self.elevation.max(1)

    def on(self, image: RangeImage) -> RangeImage:
        """The image (H, W) that the canvas was made of, as it is now."""
        boxes = [box for box in counted(tuple(self.boxes), self.instance) if box.points]
        number = np.zeros(1 + len(self.boxes), np.int32)
        number[[box.instance for box in boxes]] = 1 + np.arange(len(boxes))
        return replace(
            image,
            range=self.metres,
            reflectance=self.reflectance,
            mask=self.metres > 0,
            label=self.label,
            instance=number[self.instance],
            boxes=tuple(replace(box, instance=int(number[box.instance])) for box in boxes),
        )

    def points_at(self, at: np.ndarray) -> np.ndarray:
        """Points (N, 3), metres."""
        return self.points.reshape(-1, 3)[at]

    def rays_at(self, at: np.ndarray) -> np.ndarray:
        """Rays (N, 3) of length 1."""
        return self.rays.reshape(-1, 3)[at]

    def to_ground(self, at: np.ndarray, level: float) -> np.ndarray:
        """(N,) metres along rays to flat ground at a height, metres above the sensor's origin; infinite for none."""
        down = self.rays_at(at)[:, 2]
        return np.where(down < -0.01, level / np.minimum(down, -0.01), np.inf)

    def things(self, of: int) -> list[np.ndarray]:
        """Places (n,) of the returns of each thing of a class, FEW at least: what hangs together, seen from above."""
        at = np.flatnonzero(self.label == of)
        if not len(at):
            return []
        cells = np.floor(self.points_at(at)[:, :2] / CELL).astype(np.int64)
        steps = [x * (1 << 20) + y for x in range(REACH) for y in range(1 - REACH, REACH)]
        thing = pieces(cells @ [1 << 20, 1], steps)
        return [at[thing == number] for number in np.flatnonzero(np.bincount(thing) >= FEW)]

    def level(self, middle: np.ndarray) -> float:
        """Height of the ground around a thing's middle (3,), metres above the sensor's origin."""
        x, y = (self.points[..., axis] - middle[axis] for axis in (0, 1))
        near = x * x + y * y < AROUND**2
        ground = self.points[..., 2][near & GROUND[self.label] & (self.metres > 0)]
        return float(np.median(ground)) if len(ground) >= FEW else -self.sensor.mount

    def window(self, ahead: float, azimuths: tuple[float, float], elevations: tuple[float, float]) -> np.ndarray:
        """Places of the rays that go between two azimuths, radians to the left of `ahead`, and two elevations, and that
        nothing blocks."""
        low, high = self.reach
        rows = np.flatnonzero((high >= elevations[0]) & (low <= elevations[1]))  # a few of them: it is asked often
        around = (self.azimuth[rows] - ahead + np.pi) % (2 * np.pi) - np.pi
        between = (around >= azimuths[0]) & (around <= azimuths[1])
        between &= (self.elevation[rows] >= elevations[0]) & (self.elevation[rows] <= elevations[1])
        row, column = np.nonzero(between & ~hidden(self.sensor)[rows])
        return rows[row] * self.sensor.width + column

    def seen(self, at: np.ndarray, middle: np.ndarray) -> tuple[float, float, float]:
        """Azimuth of a middle (3,), and from where to where around it the points `at` are seen, radians."""
        points, ahead = self.points_at(at), float(np.arctan2(middle[1], middle[0]))
        return ahead, *span(np.arctan2(points[:, 1], points[:, 0]) - ahead)

    def cast(self, mesh: Mesh, tint: float, rng: np.random.Generator) -> tuple[Returns, np.ndarray]:
        """What the rays around a thing, `tint` spreads brighter than usual, bring back of it, and their places (N,)."""
        sensor, corners = self.sensor, mesh.corners.reshape(-1, 3)
        ahead = np.arctan2(*corners.mean(0)[[1, 0]])
        low, high = span(np.arctan2(corners[:, 1], corners[:, 0]) - ahead)
        heights = np.arctan2(corners[:, 2], np.hypot(corners[:, 0], corners[:, 1]))
        at = self.window(ahead, (low - 0.01, high + 0.01), (heights.min() - 0.02, heights.max() + 0.02))
        number = np.cumsum(~hidden(sensor)) - 1
        each = Lasers(*(part[number[at]] for part in lasers(sensor)))
        starts, rays = self.starts[at // sensor.width], self.rays_at(at)
        return sense(alone(mesh, tint), FewTriangles(mesh.corners), starts, rays, each, rng, sensor.max_range), at

    def put(
        self, at: np.ndarray, metres: np.ndarray, reflectance: np.ndarray, label: np.ndarray, instance: int = 0
    ) -> None:
        """Sets what rays bring back, (N,) each, 0 for no return."""
        for whole, values in ((self.metres, metres), (self.reflectance, reflectance), (self.label, label)):
            whole.flat[at] = np.where(metres > 0, values, 0)
        self.instance.flat[at] = np.where(metres > 0, instance, 0)
        self.points.reshape(-1, 3)[at] = levelled(self.sensor, self.sensor.points(self.metres, at))

    def put_returns(self, at: np.ndarray, found: Returns, where: np.ndarray, instance: int = 0) -> None:
        """`put` of what `cast` found at `at` (N,), `where` (N,) bool it is seen."""
        metres = np.where(found.distance >= self.sensor.min_range, found.distance, 0)
        self.put(at[where], metres[where], found.reflectance[where], found.label[where], instance)

    def to_sensor(self, upright: np.ndarray) -> np.ndarray:
        """Vectors (..., 3) of the frame that stands upright, in the sensor's."""
        return to_sensor(self.sensor, upright)


def canvas_of(image: RangeImage) -> Canvas:
    """A canvas of an image (H, W), metres and reflectance in [0, 1], with labels (H, W)."""
    assert image.label is not None
    sensor, label = image.sensor, np.where(image.mask, image.label, 0)
    rays, starts = sensor.directions(), np.zeros((sensor.height, 3), np.float32)
    starts[:, 2] = np.asarray(sensor.offsets or [0.0] * sensor.height, np.float32)
    rays, starts = (levelled(sensor, part) for part in (rays, starts))
    metres, reflectance = image.range * image.mask, image.reflectance * image.mask
    points = levelled(sensor, sensor.points(metres))
    angles = np.arctan2(rays[..., 1], rays[..., 0]), np.arcsin(rays[..., 2].clip(-1, 1))
    return Canvas(sensor, metres, reflectance, label, points, rays, starts, *angles, np.zeros(label.shape, np.int32))


def axis_of(canvas: Canvas) -> float | None:
    """Direction in which most of what stands does, radians, or at a right angle to it; None where too little does."""
    stands = np.isin(canvas.label, STANDING)
    along = np.roll(canvas.points[..., :2], -ALONG, 1) - canvas.points[..., :2]
    length = np.hypot(along[..., 0], along[..., 1])
    along, length = (
        part[stands & np.roll(stands, -ALONG, 1) & (length > APART[0]) & (length < APART[1])]
        for part in (along, length)
    )
    if len(length) < 10 * FEW:
        return None
    return float(np.angle((length * np.exp(4j * np.arctan2(along[:, 1], along[:, 0]))).sum())) / 4


def pieces(cells: np.ndarray, steps: list[int]) -> np.ndarray:
    """(n,) numbers of the pieces that cells (n,) are of: those that are one of these steps apart are of one."""
    key, cell = np.unique(cells, return_inverse=True)
    one, other = [], []
    for step in steps:
        there = np.searchsorted(key, key + step).clip(max=len(key) - 1)
        beside = np.flatnonzero(key[there] == key + step)
        one.append(beside)
        other.append(there[beside])
    return connected(np.concatenate(one), np.concatenate(other), len(key))[cell.ravel()]


def span(angles: np.ndarray) -> tuple[float, float]:
    """Least and greatest of angles around the one ahead, radians."""
    around = (angles + np.pi) % (2 * np.pi) - np.pi
    return float(around.min()), float(around.max())


def tint_of(material: str, shade: float, rng: np.random.Generator) -> float:
    """How much brighter than its material usually is a thing is that reads `shade` on average, in its spreads."""
    of = MATERIALS[material]
    signal = float(np.interp(shade, RESPONSE[1], RESPONSE[0])) + of.gloss / 2
    return float(np.clip((signal - of.signal) / of.spread + rng.normal(0, 0.5), *TINT))


def mirrored(gone: np.ndarray, left: np.ndarray, width: int) -> np.ndarray:
    """For each column that is gone the one of all that are left, rising, as far beyond the nearer end of the gap."""
    after = np.searchsorted(left, gone)
    a, b, share = beside(gone, left, width)
    there = np.where(share <= 0.5, after - (gone - a) % width, after - 1 + (b - gone) % width)
    return left[there % len(left)]


def levelled(sensor: Sensor, vectors: np.ndarray) -> np.ndarray:
    """Vectors (..., 3) of the sensor's frame, of one that is not tilted."""
    return vectors @ sensor_pose(sensor, np.zeros(6))[:3, :3].T.astype(np.float32) if any(sensor.tilt) else vectors


def numbered(image: RangeImage) -> RangeImage:
    """The image (H, W), of whose returns of a box's class all that lie in it have its number: some are left of what had
    been drawn there, others are named so later on."""
    if image.label is None or image.instance is None:
        return image
    number, points = image.instance.copy(), image.points().reshape(-1, 3)
    for box in image.boxes:
        own = CLASS_NUMBER["person" if box.kind == "person" else "car"]
        free = np.flatnonzero((image.label == own) & (number == 0) & image.mask)
        number.flat[free[box.holds(points[free])]] = box.instance
    return replace(image, instance=number, boxes=counted(image.boxes, number))


def to_sensor(sensor: Sensor, vectors: np.ndarray) -> np.ndarray:
    """Vectors (..., 3) of a frame that stands upright, in the sensor's."""
    return vectors @ sensor_pose(sensor, np.zeros(6))[:3, :3]


def box_around(
    mesh: Mesh,
    place: tuple[float, float],
    heights: tuple[float, float],
    yaw: float,
    sensor: Sensor,
    kind: str,
    number: int,
    points: int = 0,
    occlusion: float = 0.0,
) -> Box:
    """The box, in the sensor's frame and as streets have it, of a thing that stands still: around its mesh, of its own
    frame, put to a place and turned by yaw, radians; `heights` are those of its bottom and top.

    place, heights  metres of a frame that stands upright, the sensor at its origin
    """
    corners = mesh.corners.reshape(-1, 3).astype(np.float64)
    low, high = corners.min(0), corners.max(0)
    (x, y, _), (c, s) = (low + high) / 2, (np.cos(yaw), np.sin(yaw))
    middle = np.array([place[0] + c * x - s * y, place[1] + s * x + c * y, sum(heights) / 2])
    front, still = to_sensor(sensor, np.array([c, s, 0.0])), (0.0, 0.0, 0.0)
    x, y, z = to_sensor(sensor, middle).tolist()
    (length, width), turned = (high - low)[:2].tolist(), float(np.arctan2(front[1], front[0]))
    size = (length + 2 * MARGIN, width + 2 * MARGIN, heights[1] - heights[0] + 2 * MARGIN)
    return Box(kind, number, (x, y, z), size, turned, still, (x, y, z), turned, still, points, occlusion)
