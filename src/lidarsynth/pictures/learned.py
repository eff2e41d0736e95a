"""The picture of a learned sensor: how often each ray returned, what is blocked, and how well each beam is known."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from PIL import Image, ImageDraw, ImageFont

from lidarsynth.lidar.learning import LearnedSensor
from lidarsynth.lidar.plural import plural
from lidarsynth.pictures.colours import viridis
from lidarsynth.pictures.figure import FAINT, INK, PAPER, panel

STRIP = 1200  # pixels
BLOCKED = (214, 48, 49)
STEPS, MOST = (1, 2, 5, 10, 20, 50), 12  # degrees from tick to tick, and how many of these there may be


def learned_figure(learned: LearnedSensor) -> np.ndarray:
    """(H', W', 3) uint8: share of returns per ray with blocked ones red, and elevation and residual of every beam."""
    sensor = learned.sensor
    share = np.rint(viridis(learned.returned)).astype(np.uint8)
    share[sensor.blocked_rays()] = BLOCKED
    tall = max(round(320 / sensor.height), 1)
    strip = Image.fromarray(np.repeat(share, tall, axis=0)).resize((STRIP, tall * sensor.height), Image.Resampling.BOX)
    what = f"{sensor.name}: {sensor.height} beams, {sensor.width} columns, from {plural(learned.scans, 'scan')}"
    caption = "share of scans in which each ray returned (dark 0, bright 1; red: blocked)"
    beams = "each beam's elevation (left, degrees) and how far its points lie from it (bar, degrees)"
    bars = _bars(sensor.elevations, [ring.residual for ring in learned.rings])
    return panel([[(caption, np.asarray(strip))], [(beams, bars)]], what)


def _bars(elevations: Sequence[float], residuals: Sequence[float]) -> np.ndarray:
    """(H', STRIP, 3) uint8: a line per beam at its elevation, beside a bar as long as its residual."""
    height, left, right, edge = 480, 90, STRIP - 60, 12
    picture = Image.new("RGB", (STRIP, height), PAPER)
    draw, font = ImageDraw.Draw(picture), ImageFont.load_default(14)
    top, bottom = max(elevations) + 1, min(elevations) - 1
    longest = max(*residuals, 0.01)

    def down(elevation: float) -> float:
        return edge + (top - elevation) / (top - bottom) * (height - 2 * edge)

    for elevation, residual in zip(elevations, residuals, strict=True):
        y = down(elevation)
        draw.line([(left, y), (left + 40, y)], fill=INK)
        draw.line([(left + 60, y), (left + 60 + residual / longest * (right - left - 60), y)], fill=BLOCKED, width=2)
    step = next((step for step in STEPS if (top - bottom) / step <= MOST), STEPS[-1])
    for degrees in range(int(np.ceil(bottom / step)) * step, int(np.floor(top)) + 1, step):
        draw.text((20, down(degrees)), f"{degrees:+d}" if degrees else "0", fill=FAINT, font=font, anchor="lm")
    draw.text((right - 60, 4), f"{longest:.3f} degrees", fill=FAINT)
    return np.asarray(picture)
