"""3-D boxes of road users."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

MOVES = 0.2  # m/s from which a thing counts as moving


@dataclass(frozen=True)
class Box:
    """One road user, in the sensor frame at the scan's stamp unless said otherwise.

    kind        a word of streets' actors.KINDS; instance: its number in this world, 1 and up, the same in all scans of
                it; of generated scans, which are a world each, in its scan
    centre      (3,) m, of the box; size: length, width, height in m; yaw: rad, of its front, counter-clockwise from x
    velocity    (3,) m/s over ground
    place, heading, world_velocity: centre, yaw and velocity in the world's frame; spin: rad/s, of its yaw
    points      how many returns are labelled with it; occlusion: share of its first hits that others hide, 0 to 1; what
                is seen through another's pane is not hidden
    late        s after the stamp at which it was where the box stands, None = the stamp: centre, place, yaw and heading
                are of that time, so that centre - late * velocity is where it is at the stamp
    """

    kind: str
    instance: int
    centre: tuple[float, float, float]
    size: tuple[float, float, float]
    yaw: float
    velocity: tuple[float, float, float]
    place: tuple[float, float, float]
    heading: float
    world_velocity: tuple[float, float, float]
    points: int
    occlusion: float
    late: float | None = None
    spin: float = 0.0

    @property
    def moves(self) -> bool:
        """Faster than MOVES."""
        return float(np.linalg.norm(self.velocity)) > MOVES

    def corners(self) -> np.ndarray:
        """(8, 3) m in the sensor frame: the lower face counter-clockwise from the front left, then the upper."""
        length, width, height = self.size
        unit = np.array([(1, 1), (-1, 1), (-1, -1), (1, -1)]) / 2 * (length, width)
        flat = unit @ np.array([[np.cos(self.yaw), np.sin(self.yaw)], [-np.sin(self.yaw), np.cos(self.yaw)]])
        levels = [np.column_stack([flat, np.full(4, z)]) for z in (-height / 2, height / 2)]
        return np.concatenate(levels) + self.centre

    def holds(self, points: np.ndarray) -> np.ndarray:
        """(N,) bool: which of the points (N, 3) m, in the sensor frame, lie inside."""
        x, y, z = (points - np.asarray(self.centre)).T
        ahead, left = np.cos(self.yaw) * x + np.sin(self.yaw) * y, np.cos(self.yaw) * y - np.sin(self.yaw) * x
        return np.all(np.abs([ahead, left, z]) <= np.array(self.size)[:, None] / 2, axis=0)

    def record(self) -> dict[str, Any]:
        """Plain numbers, as the JSON files hold them."""
        rounded = {
            key: [round(v, 4) for v in value] if isinstance(value, tuple) else value
            for key, value in vars(self).items()
            if value is not None
        }
        late = {} if self.late is None else {"late": round(self.late, 5)}
        return rounded | {key: round(getattr(self, key), 5) for key in ("yaw", "heading", "occlusion", "spin")} | late


def counted(boxes: tuple[Box, ...], instance: np.ndarray) -> tuple[Box, ...]:
    """The boxes with as many points as there are of each in `instance`, ints of any shape, 0 for none."""
    points = np.bincount(instance.ravel(), minlength=1 + max((box.instance for box in boxes), default=0))
    return tuple(replace(box, points=int(points[box.instance])) for box in boxes)
