"""Values of the papers' tables, shown beside measured ones where the data and the settings are the paper's."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass


@dataclass(frozen=True)
class Published:
    """A table of a paper: method -> row of the protocol's report -> value as that report shows it.

    sequences   parts of the names of the images that it was measured on
    corruption  the recipe of what was hidden
    """

    source: str
    sequences: tuple[str, ...]
    corruption: str
    methods: Mapping[str, Mapping[str, float]]


def _upsampling(metres: float, reflectance: float | None, iou: float) -> dict[str, float]:
    values = {"range MAE": metres, "IoU": iou}
    return values if reflectance is None else values | {"reflectance MAE": reflectance}


PUBLISHED: dict[str, Published] = {
    "r2dm-upsampling-2024": Published(
        "Nakashima & Kurazume, ICRA 2024, KITTI-360 test, 4x beams; the segmenter saw true reflectance for LiDAR-SR "
        "and ILN",
        ("_drive_0000_sync", "_drive_0002_sync"),
        "beams:4",
        {
            "nearest": _upsampling(2.083, 0.106, 18.78),
            "bilinear": _upsampling(2.110, 0.101, 18.17),
            "bicubic": _upsampling(2.297, 0.108, 18.54),
            "LiDAR-SR": _upsampling(2.085, None, 21.61),
            "ILN": _upsampling(2.237, None, 21.80),
        },
    )
}


def published(protocol: str, method: str | None, names: Sequence[str], corruption: str) -> Mapping[str, float]:
    """The paper's values of a method, {} where there are none or the images or what was hidden are not the paper's."""
    table = PUBLISHED.get(protocol)
    if table is None or method is None or why_not(protocol, names, corruption):
        return {}
    return table.methods.get(method, {})


def why_not(protocol: str, names: Sequence[str], corruption: str) -> str:
    """Why the paper's values are not shown, or ''."""
    table = PUBLISHED.get(protocol)
    if table is None:
        return ""
    if corruption != table.corruption:
        return f"not shown, the paper hides {table.corruption}, here it is {corruption}"
    if all(any(part in name for part in table.sequences) for name in names):
        return ""
    return f"not shown, they are of {table.source.split(';')[0]}, and these are other scans"
