"""Shapes of what stands beside some streets: lorries, trailers, fences and walls of more kinds, crash barriers, panels
larger than signs."""

from __future__ import annotations

from itertools import pairwise

import numpy as np

from lidarsynth.streets import shapes
from lidarsynth.streets.shapes import Mesh, box, frustum, join, moved, wheel


def vehicles() -> dict[str, list[Mesh]]:
    """Heavy ones, metres, x forward, wheels on the ground."""
    load = wheel(1.15, 7.6, "canvas", "truck", sides=14)
    tank = moved(load, -1.4, 0, 2.2, yaw=np.pi / 2)
    return {
        "lorry": [
            join(_cab(6.6, 3.7), _body(-9.6, 4.0, (1.15, 4.0), "truck"), _axles("truck", (-8.2, -6.9, -5.6, 4.0, 5.7))),
            join(_cab(3.4, 2.7), _body(-3.4, 1.5, (0.95, 3.3), "truck"), _axles("truck", (-2.2, 2.5))),
            join(_cab(3.7, 3.0), _bed(-3.7, 1.6, "truck"), _axles("truck", (-2.7, -1.4, 2.6))),
            join(_cab(5.1, 3.3), tank, _axles("truck", (-4.2, -2.9, 2.4, 3.9))),
        ],
        "trailer": [
            join(_body(-2.6, 2.6, (0.4, 2.6), "other-vehicle", "paint", 1.12), _axles("other-vehicle", (-0.3,), 0.32)),
            join(_body(-1.6, 1.6, (0.5, 2.1), "other-vehicle", "canvas", 0.9), _axles("other-vehicle", (-0.2,), 0.32)),
            join(_bed(-2.4, 2.4, "other-vehicle"), _axles("other-vehicle", (-0.8, 0.2), 0.35)),
        ],
    }


def _cab(front: float, height: float) -> Mesh:
    """A cab of 2 m whose front is at x = front."""
    return join(box((front - 2.0, front), (-1.22, 1.22), (0.5, height), "paint", "truck"),
                box((front - 0.02, front + 0.02), (-1.05, 1.05), (0.55 * height, 0.85 * height), "glass", "truck"),
                box((front - 0.9, front - 0.3), (-1.24, 1.24), (0.55 * height, 0.8 * height), "glass", "truck"),
                box((front, front + 0.03), (-0.26, 0.26), (0.55, 0.68), "plate", "truck"))  # fmt: skip


def _body(
    back: float, front: float, z: tuple[float, float], label: str, of: str = "canvas", half: float = 1.27
) -> Mesh:
    return join(box((back, front), (-half, half), z, of, label),
                box((back - 0.02, back), (-0.26, 0.26), (z[0] + 0.1, z[0] + 0.22), "plate", label))  # fmt: skip


def _bed(back: float, front: float, label: str) -> Mesh:
    """An open bed on a frame, with a heap on it."""
    sides = [box((back, front), bounds, (1.0, 1.8), "paint", label) for bounds in ((-1.25, -1.2), (1.2, 1.25))]
    ends = [box((x, x + 0.05), (-1.2, 1.2), (1.0, 1.8), "paint", label) for x in (back, front - 0.05)]
    floor = box((back, front), (-1.2, 1.2), (0.9, 1.0), "dark", label)
    heap = moved(frustum((1.1, 0.3), (1.0, 2.0), 8, "gravel", label), (back + front) / 2)
    return join(*sides, *ends, floor, heap)


def _axles(label: str, places: tuple[float, ...], radius: float = 0.5) -> Mesh:
    tyre = wheel(radius, 0.3, "tyre", label)
    return join(*(moved(tyre, x, y, radius) for x in places for y in (-1.05, 1.05)))


def furniture(rng: np.random.Generator) -> dict[str, list[Mesh]]:
    """Pieces of two metres along x of fences, walls and barriers; panels that face +x, feet on the ground."""
    return {
        "board fence": [_boards(h, of, slit) for h, of, slit in (
            (1.0, "fence", 0.03), (1.4, "wall", 0.0), (1.8, "fence", 0.015), (1.8, "canvas", 0),
            (2.0, "wall", 0.01))],
        "mesh fence": [_mesh(h, thick) for h, thick in ((1.2, 0.012), (1.7, 0.012), (2.2, 0.02))],
        "railed wall": [join(box((-1.01, 1.01), (-0.12, 0.12), (-0.3, foot), "wall", "fence"),
                             moved(_bars(h, 12, thick), z=foot)) for foot, h, thick in (
            (0.4, 0.7, 0.03), (0.5, 1.0, 0.08), (0.9, 0.6, 0.04))],
        "high wall": [box((-1.01, 1.01), (-0.15, 0.15), (-0.3, h), of, "fence") for h, of in (
            (2.0, "stone"), (2.5, "wall"), (3.2, "plaster"), (4.0, "canvas"))],
        "overgrown fence": [join(_mesh(h, 0.02), moved(_leaves(rng, h, count), y=0.15)) for h, count in (
            (1.3, 26), (1.6, 50), (1.9, 36))],
        "concrete barrier": [join(box((-1.01, 1.01), (-0.3, 0.3), (-0.1, 0.25), "wall", "fence"),
                                  box((-1.01, 1.01), (-0.12, 0.12), (0.25, h), "wall", "fence")) for h in (0.8, 1.1)],
        "panel": [_panel(*size) for size in (
            (0.75, 0.5, 1.5), (1.0, 0.75, 0.8), (0.6, 0.4, 0.5), (1.4, 0.9, 2.6), (0.35, 0.6, 0.6))],
    }  # fmt: skip


def _boards(height: float, of: str, slit: float) -> Mesh:
    """Upright boards of 14 cm, `slit` metres apart, on posts."""
    edges = np.linspace(-1.0, 1.0, 15)
    boards = [box((a + slit / 2, b - slit / 2), (-0.012, 0.012), (0.06, height), of, "fence")
              for a, b in pairwise(edges)]  # fmt: skip
    return join(*(boards if slit else [box((-1.0, 1.0), (-0.012, 0.012), (0.06, height), of, "fence")]), _post(height))


def _mesh(height: float, thick: float) -> Mesh:
    """Wires that most beams pass, on posts."""
    wires = [box((-1.0, 1.0), (-0.004, 0.004), (z, z + thick), "fence", "fence") for z in np.arange(0.1, height, 0.2)]
    return join(_bars(height, 16, thick), *wires, _post(height))


def _bars(height: float, count: int, thick: float) -> Mesh:
    corner = [[[x, 0, 0.04], [x + thick, 0, 0.04], [x + thick, 0, height], [x, 0, height]]
              for x in np.linspace(-1, 1, count, endpoint=False)]  # fmt: skip
    return shapes.mesh(shapes.quads(np.array(corner)), "fence", "fence")


def _post(height: float) -> Mesh:
    return box((-1.0, -0.92), (-0.04, 0.04), (0, height + 0.05), "fence", "fence")


def _leaves(rng: np.random.Generator, height: float, count: int) -> Mesh:
    return shapes.hedge_leaves(rng, count, (1.0, 0.18, height / 2), 0.12)


def _panel(half: float, tall: float, foot: float) -> Mesh:
    """A plate 2 x half wide and 2 x tall high whose lower edge is `foot` m up, on two posts; retro-reflecting ahead."""
    posts = [moved(frustum((0.04, 0.04), (-0.1, foot + 2 * tall), 6, "pole", "pole"), 0, 0.7 * half * side)
             for side in (-1, 1)]  # fmt: skip
    z = (foot, foot + 2 * tall)
    return join(*posts, box((0.05, 0.06), (-half, half), z, "sign", "traffic-sign"),
                box((0.03, 0.045), (-half, half), z, "sign back", "traffic-sign"))  # fmt: skip
