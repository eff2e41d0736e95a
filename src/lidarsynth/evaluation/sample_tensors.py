"""Published samples as tensors, R2DM's (5, H, W) and LiDARGen's (2, H, W): into range images, or why they are none."""

from __future__ import annotations

import numpy as np
from torch import Tensor

from lidarsynth.lidar.depth import OVERSHOOT
from lidarsynth.lidar.scan import RangeImage
from lidarsynth.lidar.sensor import GRIDS, Sensor

NEAR, SHARE = 0.05, 0.02  # metres, and share of the depth: how far it may be from |x, y, z|
FEW = 0.01  # share of the pixels in which it may be farther
# Metres. LiDARGen codes r + 0.1 mm, so that what is empty is not 0, and judges from here on; 0 +- OVERSHOOT is nearer.
NEAREST = GRIDS["hdl-64e-lidargen"].min_range
# LiDARGen's codes of one metre, and shares of the returns below it, and of the variance between rows. Of 18 real scans
# no range is nearer and 0.14 to 0.83 of the variance is between rows; of reflectance 0.08 to 0.17, and 0.08 to 0.29.
METRE, DARK, NONE, LAYERED = 1 / 6, 0.05, 0.002, 0.3
ENOUGH = 5  # points of a row whose elevation is told
ASIDE = 5.0  # degrees between points and their columns: of real scans a fraction of one


def from_tensor(tensor: Tensor, sensor: Sensor, whole: bool = False) -> RangeImage:
    """A published sample as a range image of the sensor.

    (5, H, W): depth, x, y, z in metres, reflectance, as the official R2DM program saves; (2, H, W): LiDARGen's range
    code log2(r + 1) / 6, clipped to 63 m, and reflectance, both in [0, 1]; of NEAREST or less nothing returned.

    whole  the numbers of such pixels stay, as LiDARGen's mean errors are of all pixels
    Raises ValueError for another shape, NaN, infinity, or values that are not so coded: outside their limits, or a code
    beyond the sensor's farthest range.
    """
    size = (sensor.height, sensor.width)
    if tensor.ndim != 3 or tensor.shape[0] not in (2, 5) or tuple(tensor.shape[1:]) != size:
        raise ValueError(f"expected a tensor (5, {size[0]}, {size[1]}) or (2, ...), found {tuple(tensor.shape)}")
    values = tensor.detach().float().numpy()
    if not np.isfinite(values).all():
        raise ValueError(f"expected finite values, found {np.sum(~np.isfinite(values))} of NaN or infinity")
    if len(values) == 2:
        _check_order(*values)
    reflectance = within("a reflectance", values[-1], 1)
    if len(values) == 5:
        distance = within("a depth in metres", values[0], np.inf)
    else:
        farthest = max(1.0, float(np.log2(sensor.max_range + 1) / 6))
        distance = np.exp2(6 * within("a range code log2(r + 1) / 6", values[0], farthest).clip(0, 1)) - 1
    mask = distance > (0 if len(values) == 5 else NEAREST)
    kept = True if whole and len(values) == 2 else mask
    xyz = np.moveaxis(values[1:4], 0, -1).copy() if len(values) == 5 else None
    return RangeImage(distance * kept, reflectance * kept, mask, sensor, xyz=xyz)


def _check_order(code: np.ndarray, reflectance: np.ndarray) -> None:
    """Raises ValueError where the first channel can only be reflectance and the second a range code, (H, W) each: that
    has no returns within a metre, and lies in rows, twice as much as the other."""
    near = [values[values > 0] < METRE for values in (code, reflectance)]
    if not (near[0].size and near[1].size and near[0].mean() > DARK and near[1].mean() < NONE):
        return
    layered = [_between_rows(values) for values in (code, reflectance)]
    if layered[1] > max(LAYERED, 2 * layered[0]):
        raise ValueError(f"expected a range code and then a reflectance, found {near[0].mean():.0%} of the first within"
                         " a metre and none of the second: are they exchanged?")  # fmt: skip


def _between_rows(values: np.ndarray) -> float:
    """The share of the variance of the values (H, W) above 0 that is between the means of rows."""
    there = values > 0
    count = there.sum(axis=1)
    rows = (values * there).sum(axis=1) / np.maximum(count, 1)
    return float((count * (rows - values[there].mean()) ** 2).sum() / max(there.sum() * values[there].var(), 1e-12))


def within(what: str, values: np.ndarray, high: float) -> np.ndarray:
    """The values, clipped to 0 to `high`. Raises ValueError where some are farther off than OVERSHOOT."""
    least, greatest = float(values.min()), float(values.max())
    if least < -OVERSHOOT or greatest > high + OVERSHOOT:
        limits = "at least 0" if high == np.inf else f"0 to {high:.4g}"
        coded = " (lidar.depth.from_x_0 takes -1 to 1)" if least >= -1 - OVERSHOOT and greatest <= 1 + OVERSHOOT else ""
        raise ValueError(f"expected {what} of {limits}, found {least:.4g} to {greatest:.4g}: another code or scale"
                         f"{coded}")  # fmt: skip
    return values.clip(0, high)


def check_points(tensor: Tensor) -> None:
    """Raises ValueError for a (5, H, W) tensor whose depth is not the distance of its points; other shapes pass."""
    if tensor.ndim == 3 and tensor.shape[0] == 5:
        depth, *xyz = tensor.detach().double().numpy()[:4]
        check_distances("depth", depth, np.stack(xyz, -1))


def check_distances(what: str, depth: np.ndarray, xyz: np.ndarray) -> None:
    """Raises ValueError unless depths (H, W) are those of the points (H, W, 3), where there is one, of nearly all."""
    distance = np.linalg.norm(xyz.astype(np.float64), axis=-1)
    there = distance > 0
    off = there & (np.abs(distance - depth) > NEAR + SHARE * np.maximum(distance, depth))
    if off.sum() > FEW * there.sum():
        row, column = np.argwhere(off)[off.sum() // 2]
        raise ValueError(
            f"expected a {what} of |x, y, z| in metres, found another in {off.sum() / there.sum():.0%} of the pixels: "
            f"{depth[row, column]:.4g} at row {row}, column {column} for a point {distance[row, column]:.4g} m away"
        )


def beams_off(tensor: Tensor, sensor: Sensor) -> float:
    """Degrees from the rows of a (5, H, W) tensor to the sensor's beams, the median of the rows; 0 within half of the
    beams' spacing, or where no row has points. A row of a grid of edges is as high as the spacing."""
    x, y, z = tensor.detach().double().numpy()[1:4]
    if tensor.shape[1] != sensor.height or sensor.height < 2:
        return 0.0
    flat, heights = np.hypot(x, y), sensor.offsets or (0.0,) * sensor.height
    spacing, off = float(np.median(-np.diff(sensor.elevations))), []
    for row, (beam, height) in enumerate(zip(sensor.elevations, heights, strict=True)):
        there = flat[row] > 0
        if there.sum() >= ENOUGH:
            seen = float(np.median(np.degrees(np.arctan2(z[row, there] - height, flat[row, there]))))
            lower = beam - spacing if sensor.edges else beam
            off.append(max(seen - beam, lower - seen, 0.0))
    found = float(np.median(off)) if off else 0.0
    return found if found > spacing / 2 else 0.0


def columns_off(tensor: Tensor, sensor: Sensor) -> float:
    """Degrees from the directions of the points of a (5, H, W) tensor to those of their columns, the median; 0 within
    ASIDE, or where there are few. So much is off where x or y is negated, or one is the other."""
    x, y = tensor.detach().double().numpy()[1:3]
    there = np.hypot(x, y) > 0
    if tensor.shape[2] != sensor.width or tensor.shape[1] != sensor.height or there.sum() < ENOUGH:
        return 0.0
    turn = np.arctan2(y, x) - sensor.ray_angles()[1]
    found = float(np.median(np.degrees(np.abs(np.arctan2(np.sin(turn), np.cos(turn))))[there]))
    return found if found > ASIDE else 0.0
