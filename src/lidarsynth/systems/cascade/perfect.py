"""A simulator's scan in a real sensor's rays: which of its points the sensor reports, and how bright."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import torch
from torch import Tensor

from lidarsynth.lidar.columns import columns_by_steps
from lidarsynth.lidar.projection import pixel_of_points, row_of_points
from lidarsynth.lidar.scan import RangeImage, Scan
from lidarsynth.lidar.sensor import Sensor
from lidarsynth.networks.cascade import Cascade
from lidarsynth.systems.cascade.images import OBSERVED, REALISED, TUNED, Grain

ALIKE = 1.33  # a scan with so many times the sensor's columns, or so many times fewer, has its own
COLUMNS = (128, 4096)


def fitting(scan: Scan, sensor: Sensor, projection: str) -> Sensor:
    """The sensor with as many columns as the scan's steps give a turn, where that is not about its own number.

    So it is for the half of a turn that CARLA gives a tick, for points that it drops at random, and two beams in a row.
    """
    row = row_of_points(scan, sensor, projection)
    full = columns_by_steps(scan.xyz[row >= 0], row[row >= 0])
    if full is None or sensor.width / ALIKE <= full <= sensor.width * ALIKE:
        return sensor
    return sensor.resized(width=int(np.clip(full, *COLUMNS)))


def observing(network: Cascade, tuned: bool) -> tuple[Cascade, Grain]:
    """The networks whose fill says what a sensor reports, the observer where there is one, and the noise it takes.

    tuned  whether it learned from scans of this sensor
    """
    if network.observer is None:
        return network, REALISED
    return Cascade(network.coarse, network.observer), TUNED if tuned else OBSERVED


def logistic(logit: Tensor, rng: list[torch.Generator]) -> Tensor:
    """Noise of the standard logistic distribution: `logit` plus it is positive with the chance of the logit."""
    draw = torch.cat([torch.rand((1, *logit.shape[1:]), generator=one) for one in rng]).clamp(1e-6, 1 - 1e-6)
    return torch.logit(draw).to(logit)


def observed(scan: Scan, image: RangeImage, answer: RangeImage, projection: str) -> RangeImage:
    """The pixels of a perfect scan's image that return, as `answer` says; `completed` are their points, bit by bit.

    Each point shares the fate and the reflectance of its pixel; what is out of the sensor's view or limits is gone.
    """
    mask = image.mask & answer.mask
    row, column = pixel_of_points(scan, image.sensor, projection)
    depth = np.linalg.norm(scan.xyz, axis=1)
    kept = (row >= 0) & (depth >= image.sensor.min_range) & (depth <= image.sensor.max_range) & mask[row, column]
    points = replace(scan, reflectance=answer.reflectance[row, column])[kept]
    image = replace(image, reflectance=answer.reflectance).keep(mask)
    return replace(image, completed=points)
