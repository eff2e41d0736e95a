"""Pictures of a benchmark: the same scan by every method, and scores over the number of network evaluations."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch

from lidarsynth.benchmark.rows import Row
from lidarsynth.evaluation.protocols import get_protocol
from lidarsynth.lidar.scan import RangeImage
from lidarsynth.lidar.whole_file import whole_file
from lidarsynth.networks.rangenet import RangeNet
from lidarsynth.pictures.figure import GAP, Picture, class_legend, colour_bar, panel
from lidarsynth.pictures.perspective import Camera, perspective
from lidarsynth.pictures.portrait import STRIP, strips
from lidarsynth.pictures.render import MARK

VIEW = Camera(azimuth=205.0, elevation=24.0, distance=30.0, target=(7.0, 0.0, -1.0))  # nearer than a portrait's
COLUMNS = 3  # views beside each other


def side_by_side(images: Mapping[str, RangeImage], title: str, note: str = "") -> np.ndarray:
    """(H', W', 3) uint8: range and reflectance of every image by its caption, then their points from one camera.

    Points have the colour of their class where all images have labels, with `note` above, else of their height.
    """
    end = next(iter(images.values())).sensor.max_range
    by = "label" if all(image.label is not None for image in images.values()) else "height"
    width = 2 * STRIP + GAP
    rows: list[list[Picture]] = []
    for caption, image in images.items():
        distance, reflectance = strips(image, end)
        rows.append([(caption, distance), ("", reflectance)])
    rows.append([("range", colour_bar("range", STRIP, end)), ("reflectance", colour_bar("reflectance", STRIP))])
    size = ((width - GAP * (COLUMNS - 1)) // COLUMNS, (width - GAP * (COLUMNS - 1)) // COLUMNS * 10 // 16)
    views = [(caption, perspective(image, VIEW, size, by)) for caption, image in images.items()]
    views += [("", np.full((size[1], size[0], 3), 255, np.uint8))] * (-len(views) % COLUMNS)
    if by == "label":
        rows.append([(note, class_legend(list(images.values()), width))])
    rows += [views[i : i + COLUMNS] for i in range(0, len(views), COLUMNS)]
    return panel(rows, title, width)


@torch.no_grad()
def with_classes(image: RangeImage, network: RangeNet) -> RangeImage:
    """The image with the class that the network sees in every pixel."""
    channels = np.stack([image.range, *np.moveaxis(image.points(), -1, 0), image.reflectance]).astype(np.float32)
    device = network.means.device
    inputs = (torch.from_numpy(np.array(values))[None].to(device) for values in (channels, image.mask))
    label = network(network.network_input(*inputs)).argmax(1)[0].cpu().numpy()
    return replace(image, label=np.where(image.mask, label, 0))


def with_labels_of(image: RangeImage, truth: RangeImage) -> RangeImage:
    """The image with the truth's class of the same pixel, 0 where the truth is empty. Both of one size."""
    assert truth.label is not None
    return replace(image, label=np.where(image.mask & truth.mask, truth.label, 0))


def draws_scores(rows: Sequence[Row]) -> bool:
    """Whether any method was asked for several numbers of steps."""
    return any(len(group) > 1 for group in _groups(rows).values())


def save_scores(path: Path, rows: Sequence[Row], protocols: Sequence[str], title: str) -> None:
    """Write a PNG of every measure over the network evaluations per scan; bounds are dashed lines.

    Raises ImportError naming the extra where matplotlib is missing.
    """
    figure_type = plotter()
    panels = [(name, row) for name in protocols for row in get_protocol(name).rows
              if any(r.value(name, row.name) is not None for r in rows)]  # fmt: skip
    columns = min(len(panels), 3) or 1
    lines = -(-len(panels) // columns) or 1
    figure = figure_type(figsize=(4.6 * columns, 3.6 * lines), layout="constrained")
    figure.suptitle(title)
    for number, (protocol, measure) in enumerate(panels, 1):
        axes = figure.add_subplot(lines, columns, number)
        heading = f"{measure.name}, {measure.unit}" if measure.unit else measure.name
        axes.set(title=f"{heading}\n{get_protocol(protocol).title}", xlabel="network evaluations per scan")
        _curves(axes, rows, protocol, measure.name)
        if number == 1:
            axes.legend(fontsize="small")
    with whole_file(path) as scratch:
        figure.savefig(scratch, format="png", dpi=120, metadata={"Software": MARK})


def plotter():
    """matplotlib's Figure, which needs no display. Raises ImportError naming the extra that brings it."""
    try:
        from matplotlib.figure import Figure
    except ImportError as error:
        raise ImportError("curves of scores need matplotlib: pip install 'lidarsynth[viz]'") from error
    return Figure


def _curves(axes, rows: Sequence[Row], protocol: str, measure: str) -> None:
    values = [v for row in rows if (v := row.value(protocol, measure)) is not None]
    axes.set_xscale("log", base=2)
    if min(values) > 0 and max(values) > 20 * min(values):
        axes.set_yscale("log")
        axes.yaxis.set_major_formatter("{x:g}")
        axes.yaxis.set_minor_formatter(lambda value, _: f"{value:g}" if f"{value:e}"[0] in "25" else "")
    ticks: set[int] = set()
    for group, members in _groups(rows).items():
        points = [(row.evaluations, v) for row in members
                  if row.evaluations and (v := row.value(protocol, measure)) is not None]  # fmt: skip
        if len(points) > 1:
            axes.plot(*zip(*sorted(points), strict=True), marker="o", label=group)
            ticks |= {int(x) for x, _ in points}
            continue
        for row in members:
            if (value := row.value(protocol, measure)) is not None:
                axes.axhline(value, linestyle="--", linewidth=1, color=f"C{7 + len(axes.lines) % 3}", label=row.name)
    axes.set_xticks(sorted(ticks), [str(tick) for tick in sorted(ticks)])
    axes.tick_params(axis="x", which="minor", bottom=False, labelbottom=False)
    axes.grid(alpha=0.3)


def _groups(rows: Sequence[Row]) -> dict[str, list[Row]]:
    groups: dict[str, list[Row]] = {}
    for row in rows:
        groups.setdefault(row.group, []).append(row)
    return groups
