"""Casting rays at things that move while the sensor turns: each in its own frame, at the time of each ray."""

from __future__ import annotations

import numpy as np

from lidarsynth.streets.actors import Actors
from lidarsynth.streets.drive import Moment
from lidarsynth.streets.raycast import Caster, Hits
from lidarsynth.streets.world import World


class Bodies:
    """The actors' shapes, each in its own frame and built when it is first asked for."""

    def __init__(self, world: World, actors: Actors):
        self.world, self.actors = world, actors
        order = np.argsort(world.thing, kind="stable")
        ends = np.searchsorted(world.thing[order], [actors.thing, actors.thing + 1])
        self._faces = [order[a:b] for a, b in ends.T]
        self._casters: dict[int, Caster] = {}
        self.reach = np.linalg.norm(actors.size, axis=1) / 2 + 0.05

    def faces(self, actor: int) -> np.ndarray:
        """(n,) the triangles of the world that are this actor's."""
        return self._faces[actor]

    def caster(self, actor: int) -> Caster | None:
        """The actor alone, its place the origin, facing along x; None where no triangle of it is in the world."""
        if not len(self._faces[actor]):
            return None
        if actor not in self._casters:
            corners = self.world.corners[self._faces[actor]] - self.actors.place[actor].astype(np.float32)
            self._casters[actor] = Caster(turned(corners.reshape(-1, 3), -self.actors.yaw[actor]).reshape(-1, 3, 3))
        return self._casters[actor]

    def alone(self, actor: int, place: np.ndarray, yaw: np.ndarray, origins: np.ndarray, rays: np.ndarray) -> Hits:
        """First hits on this actor alone, at places (N, 3) and yaws (N,) that may differ from ray to ray."""
        caster = self.caster(actor)
        if caster is None:
            nothing = np.zeros(len(rays), np.float32)
            return np.full(len(rays), -1, np.int32), nothing + np.inf, nothing
        face, distance, cosine = caster.cast(*_from(place, yaw, origins, rays))
        return np.where(face >= 0, self._faces[actor][face], -1).astype(np.int32), distance, cosine

    def met(self, actor: int, place: np.ndarray, yaw: np.ndarray, origins: np.ndarray, rays: np.ndarray) -> int:
        """How many of the rays meet this actor if it is alone, at a place (3,) and yaw () or as in `alone`."""
        caster = self.caster(actor)
        return 0 if caster is None else int((caster.faces(*_from(place, yaw, origins, rays)) >= 0).sum())


class MovingCaster:
    """A scene in which the actors `movers` move through a turn: `cast` with the time of each ray."""

    def __init__(self, fixed: Caster, bodies: Bodies, movers: np.ndarray, moment: Moment, stamp: float):
        self.fixed, self.bodies, self.movers, self.moment, self.stamp = fixed, bodies, movers, moment, stamp

    def cast(self, origins: np.ndarray, rays: np.ndarray, times: np.ndarray | None = None) -> Hits:
        """As `Caster.cast`; times (N,) seconds on the drive's clock, None = all at the turn's stamp."""
        face, distance, cosine = self.fixed.cast(origins, rays)
        origins, rays = np.ascontiguousarray(origins), np.ascontiguousarray(rays)  # ray by ray from here on
        late = np.zeros(len(rays)) if times is None else times - self.stamp
        now, bundles = self.moment, Bundles(origins, rays)
        longest = half_turn(late)
        for actor in self.movers.tolist():
            middle = now.place[actor] + [0, 0, self.bodies.actors.middle[actor, 2]]
            slack = np.linalg.norm(now.velocity[actor]) * longest
            near = bundles.meet(middle, self.bodies.reach[actor] + slack)
            if not len(near):
                continue
            place = now.place[actor] + late[near, None] * now.velocity[actor]
            yaw = now.yaw[actor] + late[near] * now.spin[actor]
            hit = self.bodies.alone(actor, place, yaw, origins[near], rays[near])
            first = hit[1] < distance[near]
            for mine, theirs in zip((face, distance, cosine), hit, strict=True):
                mine[near[first]] = theirs[first]
        return face, distance, cosine


def half_turn(late: np.ndarray) -> float:
    """Seconds that no ray, `late` (N,) s after a turn's stamp, is away from it; 0.06 at least."""
    return max(0.06, 1.2 * float(np.abs(late).max(initial=0.0)))


def meets(origins: np.ndarray, rays: np.ndarray, middle: np.ndarray, radius: float) -> np.ndarray:
    """Numbers of the rays (N, 3) that pass within `radius` m of a point (3,)."""
    away = middle.astype(np.float32) - origins
    along = np.einsum("ij,ij->i", away, rays)
    return np.flatnonzero((np.einsum("ij,ij->i", away, away) - along**2 < radius**2) & (along > -radius))


class Bundles:
    """Rays in bundles of neighbours, so that most of those that pass by something are not looked at one by one.

    origins, rays (N, 3) float32, any number; rays of length 1.
    """

    SIZE = 16  # rays

    def __init__(self, origins: np.ndarray, rays: np.ndarray):
        self.origins, self.rays = origins, rays
        starts, ways = (_bundled(values, self.SIZE) for values in (origins, rays))
        self._start, self._way = starts.mean(axis=1), ways.mean(axis=1)
        self._way /= np.maximum(np.linalg.norm(self._way, axis=1, keepdims=True), 1e-6)
        self._apart, self._bend = (
            np.sqrt(((values - middle[:, None]) ** 2).sum(axis=2).max(axis=1))
            for values, middle in ((starts, self._start), (ways, self._way))
        )

    def meet(self, middle: np.ndarray, radius: float) -> np.ndarray:
        """Numbers of the rays that pass within `radius` m of a point (3,), as `meets` finds them."""
        away = middle.astype(np.float32) - self._start
        along, square = np.einsum("ij,ij->i", away, self._way), np.einsum("ij,ij->i", away, away)
        # A ray of a bundle is at t metres at most `apart + t bend` from where the bundle's middle is.
        slack = np.float32(radius) + self._apart
        slack = np.float32(1.001) * (slack + (np.sqrt(square) + slack) * self._bend) + np.float32(0.01)
        bundle = np.flatnonzero((square - along**2 < slack**2) & (along > -slack))
        chosen = (bundle[:, None] * self.SIZE + np.arange(self.SIZE)).ravel()
        chosen = chosen[chosen < len(self.rays)]
        origins, rays = self.origins.take(chosen, axis=0), self.rays.take(chosen, axis=0)
        return chosen[meets(origins, rays, middle, radius)]


def _bundled(values: np.ndarray, size: int) -> np.ndarray:
    """(B, size, 3) of values (N, 3); the last one fills what is missing."""
    missing = -len(values) % size
    whole = np.concatenate([values, np.repeat(values[-1:], missing, axis=0)]) if missing else values
    return whole.reshape(-1, size, 3)


def _from(place: np.ndarray, yaw: np.ndarray, origins: np.ndarray, rays: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Rays as seen from something at `place` that is turned by `yaw`."""
    return turned(origins - place.astype(np.float32), -yaw), turned(rays, -yaw)


def turned(vectors: np.ndarray, yaw: np.ndarray | float) -> np.ndarray:
    """(N, 3) float32 vectors turned about z by `yaw` radians, one for all or (N,)."""
    c, s = np.float32(1) * np.cos(yaw), np.float32(1) * np.sin(yaw)
    x, y = vectors[:, 0], vectors[:, 1]
    return np.stack([c * x - s * y, s * x + c * y, vectors[:, 2]], axis=-1).astype(np.float32)
