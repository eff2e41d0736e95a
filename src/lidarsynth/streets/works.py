"""Shapes of a construction site."""

from __future__ import annotations

from lidarsynth.streets.shapes import Mesh, box, frustum, join, moved


def things() -> dict[str, list[Mesh]]:
    """Cheap shapes of a construction site, feet on the ground."""
    planks = [box((-0.98, 0.98), (-0.03, 0.03), (z, z + 0.2), "canvas", "fence") for z in (0.25, 0.8)]
    feet = [moved(box((-0.15, 0.15), (-0.4, 0.4), (0, 0.12), "tyre", "unlabeled"), x) for x in (-0.8, 0.8)]
    posts = [moved(frustum((0.03, 0.03), (0, 1.1), 5, "pole", "fence"), x) for x in (-0.8, 0.8)]
    lamp = box((-0.85, -0.75), (-0.04, 0.04), (1.1, 1.3), "lamp", "fence")
    cone = join(frustum((0.18, 0.03), (0.04, 0.75), 8, "canvas", "unlabeled"),
                box((-0.22, 0.22), (-0.22, 0.22), (0, 0.05), "tyre", "unlabeled"))  # fmt: skip
    return {
        "barrier board": [join(*planks, *feet, *posts, lamp), join(*planks, *feet, *posts)],
        "cone": [cone],
        "heap": [frustum((1.5, 0.25), (-0.1, 1.1), 9, "gravel", "terrain")],
        "site box": [box((-1.2, 1.2), (-0.8, 0.8), (0, 1.5), "door", "unlabeled")],
    }
