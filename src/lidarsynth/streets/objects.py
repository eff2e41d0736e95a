"""The things that stand in a street, each built once at the origin: metres, x forward, z up, 0 on the ground."""

from __future__ import annotations

from functools import lru_cache

import numpy as np

from lidarsynth.streets import people, shapes, wayside, works
from lidarsynth.streets.shapes import Mesh, box, extrusion, frustum, join, leaves, moved, wheel

# Fences: height in metres, bars in two metres, metres of each, and whether there are none but posts and rails.
FENCES = ((1.1, 14, 0.05, False), (1.3, 9, 0.11, False), (1.8, 18, 0.035, False), (0.8, 0, 0.0, True))


def _wheels(label: str, axles: tuple[float, ...], radius: float, track: float) -> list[Mesh]:
    tyre = wheel(radius, 0.24, "tyre", label)
    return [moved(tyre, x, y, radius) for x in axles for y in (-track, track)]


def _plates_and_lamps(label: str, front: float, back: float, half: float, height: float) -> list[Mesh]:
    parts = []
    for end, x in ((1, front), (-1, back)):
        out = (x, x + 0.02 * end)
        ends = (min(out), max(out))
        parts.append(box(ends, (-0.26, 0.26), (height - 0.25, height - 0.12), "plate", label))
        for side in (-1, 1):
            lamp = sorted((side * (half - 0.05), side * (half - 0.35)))
            parts.append(box(ends, (lamp[0], lamp[1]), (height - 0.02, height + 0.14), "lamp", label))
    return parts


def car(length: float, belt: float, roof: float, half: float, cabin: tuple[float, float, float, float]) -> Mesh:
    """A passenger car: painted body, glass all round with pillars, wheels, plates and lamps.

    cabin: x of the rear window's foot and head, of the windscreen's head and foot.
    """
    h = length / 2
    body = [(-h, 0.30), (-h, 0.62), (-h + 0.08, belt), (cabin[3], belt), (h - 0.35, belt - 0.18), (h, belt - 0.30),
            (h, 0.28), (h - 0.25, 0.20), (-h + 0.25, 0.22)]  # fmt: skip
    widths = [half - 0.12, half - 0.03, half - 0.08, half - 0.06, half - 0.08, half - 0.12, half - 0.14, half - 0.1,
              half - 0.1]  # fmt: skip
    top = half - 0.24
    glass = extrusion([(cabin[0], belt), (cabin[1], roof - 0.06), (cabin[2], roof - 0.06), (cabin[3], belt)],
                      [half - 0.09, top, top, half - 0.09], "glass", "car")  # fmt: skip
    lid = [(cabin[1] - 0.1, roof - 0.07), (cabin[1] + 0.1, roof), (cabin[2] - 0.2, roof), (cabin[2] + 0.1, roof - 0.07)]
    parts = [extrusion(body, widths, "paint", "car"), glass, extrusion(lid, [top + 0.01] * 4, "paint", "car")]
    lean = (half - 0.09 - top) / (roof - belt)
    for x in (cabin[1] + 0.02, (cabin[1] + cabin[2]) / 2, cabin[2] - 0.08):
        for side in (-1, 1):
            post = np.array([[x - 0.06, half - 0.075, belt], [x + 0.06, half - 0.075, belt],
                             [x + 0.05, half - 0.075 - lean * (roof - belt), roof - 0.04],
                             [x - 0.05, half - 0.075 - lean * (roof - belt), roof - 0.04]])  # fmt: skip
            parts.append(shapes.mesh(shapes.quads(post * [1, side, 1]), "paint", "car"))
    for side in (-1, 1):
        mirror = sorted((side * half, side * (half + 0.16)))
        parts.append(
            box((cabin[3] - 0.35, cabin[3] - 0.22), (mirror[0], mirror[1]), (belt, belt + 0.14), "paint", "car")
        )
    parts += _wheels("car", (-h + 0.75, h - 0.85), 0.32, half - 0.14)
    return join(*parts, *_plates_and_lamps("car", h, -h, half - 0.1, 0.66))


def van(length: float, roof: float, half: float, label: str = "car") -> Mesh:
    """A box with a short bonnet: delivery van or minibus."""
    h = length / 2
    body = [(-h, 0.35), (-h, roof - 0.1), (-h + 0.1, roof), (h - 1.3, roof), (h - 0.55, 1.15), (h, 0.95), (h, 0.3)]
    widths = [half - 0.04, half - 0.1, half - 0.14, half - 0.14, half - 0.08, half - 0.12, half - 0.12]
    parts = [extrusion(body, widths, "paint", label)]
    screen = np.array([[h - 1.24, -half + 0.25, roof - 0.1], [h - 1.24, half - 0.25, roof - 0.1],
                       [h - 0.5, half - 0.22, 1.16], [h - 0.5, -half + 0.22, 1.16]])  # fmt: skip
    parts.append(shapes.mesh(shapes.quads(screen + np.array([0.03, 0, 0])), "glass", label))
    for side in (-1, 1):
        pane = sorted((side * (half - 0.06), side * (half - 0.03)))
        parts.append(box((h - 1.75, h - 0.85), (pane[0], pane[1]), (1.15, roof - 0.3), "glass", label))
    parts += _wheels(label, (-h + 0.9, h - 0.9), 0.34, half - 0.12)
    return join(*parts, *_plates_and_lamps(label, h, -h, half - 0.1, 0.75))


def truck(length: float, height: float) -> Mesh:
    """A cab before a canvas or metal body, open below."""
    h = length / 2
    parts = [
        box((h - 1.9, h), (-1.2, 1.2), (0.5, min(height, 2.9)), "paint", "truck"),
        box((h - 0.02, h + 0.02), (-1.05, 1.05), (1.6, 2.4), "glass", "truck"),
        box((-h, h - 2.1), (-1.25, 1.25), (1.1, height), "canvas", "truck"),
        box((-h, h - 1.5), (-0.4, 0.4), (0.6, 1.05), "dark", "truck"),
        *_wheels("truck", (-h + 1.0, -h + 2.2, h - 1.3), 0.5, 1.05),
    ]
    return join(*parts, *_plates_and_lamps("truck", h + 0.01, -h, 1.1, 0.8))


def bus(length: float) -> Mesh:
    """A city bus: windows along the sides."""
    h = length / 2
    parts = [box((-h, h), (-1.27, 1.27), (0.3, 3.1), "paint", "other-vehicle")]
    for x in np.arange(-h + 0.4, h - 1.2, 1.5):
        parts.append(box((x, x + 1.3), (-1.29, 1.29), (1.3, 2.4), "glass", "other-vehicle"))
    parts.append(box((h - 0.01, h + 0.02), (-1.1, 1.1), (1.1, 2.7), "glass", "other-vehicle"))
    return join(*parts, *_wheels("other-vehicle", (-h + 2.6, h - 2.6), 0.48, 1.18))


STRIDE = 1.4  # radians of the legs for those of the arms: boxes as long as those of KITTI, 0.84 m on average


def person(rng: np.random.Generator, label: str = "person", seated: bool = False) -> Mesh:
    """A human in mid-stride or, on two wheels, a seated one."""
    stride, lean = rng.uniform(0.1, 0.35), rng.uniform(0.25, 0.5) if seated else rng.uniform(-0.05, 0.1)
    legs = _seated_legs(stride, label) if seated else _walking_legs(STRIDE * stride, label)
    rings = (((0.16, 0.21), (0.0, 0.45)), ((0.21, 0.07), (0.45, 0.62)))  # waist to shoulders to neck
    head = (((0.06, 0.11), (0.6, 0.75)), ((0.11, 0.04), (0.75, 0.92)))
    trunk = [frustum(radii, z, 8, "cloth", label) for radii, z in rings]
    trunk += [frustum(radii, z, 6, "skin", label) for radii, z in head]
    reach, swing = (0.1, 0.3) if seated else (0.6 * np.sin(stride), stride)  # of the hands; arms go against the legs
    arms = [moved(frustum((0.05, 0.06), (0.0, 0.6), 5, "cloth", label), reach * s, 0.24 * s, -0.02, tilt=-swing * s)
            for s in (-1, 1)]  # fmt: skip
    return join(*legs, moved(join(*trunk, *arms), z=0.83, tilt=lean))


def _seated_legs(stride: float, label: str) -> list[Mesh]:
    leg = frustum((0.07, 0.10), (0.0, 0.85), 6, "cloth", label)
    return [moved(leg, -0.85 * np.sin(swing) * 0.5, side, 0.0, tilt=swing * 0.6)
            for side, swing in ((0.1, stride), (-0.1, -stride))]  # fmt: skip


def _walking_legs(swing: float, label: str) -> list[Mesh]:
    """Two straight legs from the hip, `swing` radians behind and before it, on feet that point ahead; as many triangles
    as the seated ones."""
    leg = frustum((0.065, 0.10), (0.0, 0.88), 4, "cloth", label)
    heel, ankle, toe = [-0.08, 0.0, 0.0], [-0.05, 0.0, 0.12], [0.17, 0.0, 0.02]
    edge = np.array([[0, -0.045, 0], [0, 0.045, 0]])
    top = shapes.quads(np.array([ankle + edge[0], toe + edge[0], toe + edge[1], ankle + edge[1]]))
    sides = [[heel + out, toe + out, ankle + out] for out in edge]
    foot = shapes.mesh(np.concatenate([top, sides]), "tyre", label)
    parts = []
    for side, turn in ((0.1, swing), (-0.1, -swing)):
        x = -0.88 * np.sin(turn)
        parts += [moved(leg, x, side, 0.0, tilt=turn), moved(foot, x, side, 0.0)]
    return parts


def two_wheeler(label: str, heavy: bool) -> Mesh:
    """A bicycle, or a motorcycle when heavy."""
    radius, width = (0.31, 0.13) if heavy else (0.33, 0.03)
    parts = []
    for x in (-0.52, 0.52):
        rim = frustum((radius, radius), (-width / 2, width / 2), 14, "tyre", label)
        upright = Mesh(rim.corners[..., [0, 2, 1]], rim.material, rim.label)
        parts.append(moved(upright, x, 0, radius))
        if heavy:
            parts.append(moved(wheel(radius, width, "tyre", label), x, 0, radius))
    bars = [((-0.52, 0.33), (-0.1, 0.85)), ((-0.1, 0.3), (-0.15, 0.95)), ((-0.1, 0.3), (0.42, 0.8)),
            ((-0.12, 0.82), (0.42, 0.82)), ((0.52, 0.33), (0.38, 1.05)), ((-0.1, 0.3), (-0.52, 0.33))]  # fmt: skip
    thick = 0.12 if heavy else 0.025
    for (xa, za), (xb, zb) in bars:
        strip = np.array([[xa, -thick, za], [xb, -thick, zb], [xb, thick, zb + 0.05], [xa, thick, za + 0.05]])
        parts.append(shapes.mesh(shapes.quads(strip), "fence", label))
        parts.append(shapes.mesh(shapes.quads(strip * [1, 0, 1] + [[0, 0, -0.02], [0, 0, -0.02], [0, 0, 0], [0, 0, 0]]),
                                 "fence", label))  # fmt: skip
    parts.append(box((0.3, 0.4), (-0.3, 0.3), (1.02, 1.07), "fence", label))
    if heavy:
        parts.append(box((-0.3, 0.3), (-0.17, 0.17), (0.35, 0.85), "paint", label))
    return join(*parts)


def rider(rng: np.random.Generator, label: str, heavy: bool) -> Mesh:
    """A human on two wheels, all of the rider's class as SemanticKITTI has it."""
    return join(two_wheeler(label, heavy), moved(person(rng, label, seated=True), -0.15, 0, 0.12))


def tree(rng: np.random.Generator, height: float, foot: float, spread: float, leaf_count: int) -> Mesh:
    """A trunk and a crown that starts `foot` metres above the ground, with a few branches."""
    radius = rng.uniform(0.09, 0.24)
    parts = [frustum((radius * 1.5, radius * 1.05), (-0.2, 0.35), 7, "bark", "trunk"),
             frustum((radius * 1.05, radius * 0.7), (0.35, foot + 1), 7, "bark", "trunk")]  # fmt: skip
    for _ in range(4):
        branch = frustum((radius * 0.5, radius * 0.2), (0, spread * 0.8), 4, "bark", "trunk")
        parts.append(moved(branch, z=foot - 0.2, yaw=rng.uniform(0, 6.28), tilt=rng.uniform(0.4, 1.0)))
    lobes = 5
    for _ in range(lobes):
        angle, far = rng.uniform(0, 6.28), spread * rng.uniform(0.2, 0.6)
        up = foot + (height - foot) * rng.uniform(0.25, 0.6)
        radii = (spread * rng.uniform(0.4, 0.7), spread * rng.uniform(0.4, 0.7), (up - foot) * rng.uniform(0.8, 1.1))
        parts.append(leaves(rng, leaf_count // lobes, (far * np.cos(angle), far * np.sin(angle), up), radii, 0.16, 0.6))
    return join(*parts)


def bush(rng: np.random.Generator, height: float, spread: float, count: int, leaf: float) -> Mesh:
    """A shrub of several lobes, denser towards the ground."""
    parts = []
    for _ in range(4):
        angle, far, up = rng.uniform(0, 6.28), spread * rng.uniform(0, 0.6), height * rng.uniform(0.25, 0.6)
        radii = (spread * rng.uniform(0.4, 0.7), spread * rng.uniform(0.4, 0.7), up * rng.uniform(0.8, 1.2))
        parts.append(leaves(rng, count // 4, (far * np.cos(angle), far * np.sin(angle), up), radii, leaf, 0.5))
    return join(*parts)


def hedge(rng: np.random.Generator, height: float, depth: float) -> Mesh:
    """Two metres of cut hedge along x: a core and loose leaves on its faces."""
    core = box((-1.02, 1.02), (-depth / 2 + 0.12, depth / 2 - 0.12), (0, height - 0.12), "leaves", "vegetation")
    return join(core, shapes.hedge_leaves(rng, 64, (1.05, depth / 2, height / 2), 0.12))


def wild_hedge(rng: np.random.Generator, height: float, depth: float) -> Mesh:
    """Two metres of uncut greenery along x: a bulging core, leaves and twigs that stick out."""
    parts = []
    for x in (-0.75, 0.0, 0.75):
        middle, half = height * rng.uniform(0.42, 0.55), depth * rng.uniform(0.3, 0.5)
        z = np.array([0, middle, 2 * middle - 0.1])
        width = np.array([half * 0.8, half * rng.uniform(0.8, 1.1), half * 0.35])
        for low in (0, 1):
            core = frustum((width[low], width[low + 1]), (z[low], z[low + 1]), 5, "leaves", "vegetation")
            parts.append(moved(core, x, rng.normal(0, 0.1 * depth)))
        parts.append(leaves(rng, 22, (x, 0, middle), (0.6, depth * 0.6, middle * 1.05), 0.15, 0.75))
    return join(*parts)


def fence(height: float, bars: int, thick: float, posts_only: bool = False) -> Mesh:
    """Two metres of fence along x with gaps: a post, two rails, `bars` upright bars."""
    parts = [box((-1.0, -0.93), (-0.035, 0.035), (0, height + 0.05), "fence", "fence")]
    for z in (0.15, height - 0.12):
        parts.append(box((-1, 1), (-0.02, 0.02), (z, z + 0.06), "fence", "fence"))
    if not posts_only:
        for x in np.linspace(-1, 1, bars, endpoint=False):
            corner = [[x, 0, 0.05], [x + thick, 0, 0.05], [x + thick, 0, height], [x, 0, height]]
            parts.append(shapes.mesh(shapes.quads(np.array(corner)), "fence", "fence"))
    return join(*parts)


def garden_wall(height: float) -> Mesh:
    """Two metres of wall along x."""
    return box((-1.01, 1.01), (-0.12, 0.12), (-0.3, height), "wall", "fence")


def guard_rail() -> Mesh:
    """Two metres of crash barrier along x."""
    corner = np.array([[-1.01, 0.04, 0.45], [1.01, 0.04, 0.45], [1.01, 0, 0.6], [-1.01, 0, 0.6]])
    upper = corner * [1, 1, -1] + [0, 0, 1.2]
    rail = shapes.mesh(shapes.quads(np.stack([corner, upper])), "fence", "fence")
    return join(rail, box((-0.06, 0.06), (-0.12, 0.0), (0, 0.7), "fence", "fence"))


def pole(height: float, radius: float) -> Mesh:
    """A lamp post, mast or bollard."""
    return frustum((radius * 1.1, radius * 0.8), (-0.1, height), 7, "pole", "pole")


def sign(rng: np.random.Generator, round_plate: bool, height: float) -> Mesh:
    """A post with a plate that faces +x: retro-reflecting in front, dull behind."""
    post = frustum((0.035, 0.035), (-0.1, height + 0.35), 6, "pole", "pole")
    half = rng.uniform(0.28, 0.5)
    sides = 10 if round_plate else 4
    angle = np.linspace(0, 2 * np.pi, sides, endpoint=False) + np.pi / 4
    rim = np.stack([np.zeros(sides), half * np.cos(angle), height + half * np.sin(angle)], axis=-1)
    middle = np.broadcast_to([0, 0, height], rim.shape)
    fan = np.stack([middle, rim, np.roll(rim, -1, axis=0)], axis=1)
    front = shapes.mesh(fan + np.array([0.05, 0, 0]), "sign", "traffic-sign")
    return join(post, front, shapes.mesh(fan + np.array([0.04, 0, 0]), "sign back", "traffic-sign"))


def _vehicles() -> dict[str, list[Mesh]]:
    return {
        "car": [
            car(3.9, 0.92, 1.46, 0.84, (-1.85, -1.45, 0.05, 0.95)),  # hatchback
            car(4.2, 0.92, 1.45, 0.87, (-2.00, -1.45, 0.10, 1.05)),
            car(4.6, 0.94, 1.43, 0.89, (-1.75, -1.05, 0.25, 1.05)),  # saloon
            car(4.7, 0.95, 1.47, 0.90, (-2.25, -1.95, 0.20, 1.10)),  # estate
            car(4.5, 1.05, 1.70, 0.92, (-2.15, -1.85, 0.30, 1.05)),  # off-roader
            car(3.6, 0.95, 1.50, 0.80, (-1.75, -1.45, 0.20, 0.95)),
        ],
        "van": [van(4.9, 1.95, 0.97), van(5.6, 2.45, 1.0), van(4.4, 1.85, 0.9)],
        "truck": [truck(7.0, 3.2), truck(9.5, 3.6)],
        "bus": [bus(11.5)],
    }


SHAPES = 2024  # seed of those that are drawn at random
# How many variants of these every street draws from; those behind them come where more of all shapes is asked for.
USUAL = {"person": 8, "bicyclist": 3, "motorcyclist": 2, "bicycle": 1, "motorcycle": 1}


@lru_cache(maxsize=1)
def library() -> dict[str, list[Mesh]]:
    """Every kind of thing -> its variants. The same on every call and machine."""
    kinds = _kinds()
    for kind, others in _of_more_shapes(kinds).items():
        assert len(kinds[kind]) == USUAL[kind]
        kinds[kind] += others
    return kinds


def _of_more_shapes(kinds: dict[str, list[Mesh]]) -> dict[str, list[Mesh]]:
    """More variants of people and two-wheelers, none of which moves those that were there."""
    rng = np.random.default_rng(2026)
    walking = [person(rng) for _ in range(12)]
    return {
        "person": people.walkers(rng, walking),
        "bicyclist": people.cyclists(rng, two_wheeler("bicyclist", False)),
        "motorcyclist": people.motorcyclists(rng, two_wheeler("motorcyclist", True)),
        **{kind: people.two_wheelers(rng, kinds[kind][0], kind) for kind in ("bicycle", "motorcycle")},
    }


@lru_cache(maxsize=1)
def cars_and_people() -> dict[str, list[Mesh]]:
    """Those of `library` that every street has, without building the others."""
    return _first(np.random.default_rng(SHAPES))


def _first(rng: np.random.Generator) -> dict[str, list[Mesh]]:
    return _vehicles() | {"person": [person(rng) for _ in range(USUAL["person"])]}


def _kinds() -> dict[str, list[Mesh]]:
    rng = np.random.default_rng(SHAPES)
    two = {"bicycle": False, "motorcycle": True}
    return _first(rng) | {
        "bicyclist": [rider(rng, "bicyclist", False) for _ in range(3)],
        "motorcyclist": [rider(rng, "motorcyclist", True) for _ in range(2)],
        **{name: [two_wheeler(name, heavy)] for name, heavy in two.items()},
        "tree": [tree(rng, rng.uniform(6, 10), rng.uniform(1.6, 3.2), rng.uniform(1.4, 2.6), 170) for _ in range(10)],
        "young tree": [
            tree(rng, rng.uniform(3, 5), rng.uniform(0.9, 1.8), rng.uniform(0.8, 1.4), 150) for _ in range(6)
        ],
        "bush": [bush(rng, rng.uniform(0.8, 2.2), rng.uniform(0.6, 1.4), 180, 0.13) for _ in range(8)],
        "thicket": [bush(rng, rng.uniform(3, 6), rng.uniform(2, 3.5), 320, 0.32) for _ in range(6)],
        "hedge": [hedge(rng, h, d) for h, d in ((0.9, 0.6), (1.4, 0.8), (1.9, 0.9), (2.3, 1.1))],
        "wild hedge": [wild_hedge(rng, h, d) for h, d in ((1.6, 1.2), (2.2, 1.6), (2.8, 1.8), (3.4, 2.2), (4.2, 2.6))],
        "fence": [fence(*how) for how in FENCES],
        "garden wall": [garden_wall(height) for height in (0.5, 0.9, 1.3, 1.8, 2.2)],
        "lamp": [pole(6.0, 0.08), pole(7.0, 0.11), pole(9.0, 0.16)],
        "guard rail": [guard_rail()],
        "bollard": [pole(0.9, 0.06), pole(1.0, 0.09)],
        "sign": [sign(rng, bool(k % 2), h) for k, h in enumerate((2.2, 2.3, 1.9, 2.5, 1.2, 2.1))],
        "bin": [box((-0.3, 0.3), (-0.3, 0.3), (0, 1.1), "door", "unlabeled"),
                box((-0.7, 0.7), (-0.5, 0.5), (0, 1.3), "door", "unlabeled"),
                box((-0.35, 0.35), (-0.2, 0.2), (0, 1.5), "canvas", "unlabeled")],
        **works.things(),
        **wayside.vehicles(),
        "coach": [bus(9.0), bus(13.5)],
        **wayside.furniture(rng),
    }  # fmt: skip
