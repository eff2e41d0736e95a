"""The pixels of a model's image that are known: of a mask, of a sparser sensor's scan, put back."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from lidarsynth.lidar.columns import as_scanned
from lidarsynth.lidar.projection import project
from lidarsynth.lidar.recognition import recognise
from lidarsynth.lidar.scan import RangeImage, Scan, check_seen, laid_out
from lidarsynth.lidar.sensor import Sensor, get_sensor, same_rays


def known_pixels(image: RangeImage, known: np.ndarray | None) -> np.ndarray:
    """(H, W) bool: the given pixels, or the measured ones, laid out as torch takes them. Raises ValueError for another
    shape or type."""
    known = image.mask if known is None else known
    if not isinstance(known, np.ndarray):
        raise ValueError(f"known must be {image.shape} bool, got a {type(known).__name__}")
    if known.shape != image.shape or known.dtype != np.bool_:
        raise ValueError(f"known must be {image.shape} bool, got {known.shape} {known.dtype}")
    return laid_out(known)


def of_rays(image: RangeImage, sensor: Sensor) -> RangeImage:
    """The image. Raises ValueError for one of other rays than the sensor's."""
    if image.shape != (sensor.height, sensor.width):
        raise ValueError(f"expected an image of {sensor.height} x {sensor.width}, found {image.shape}")
    if not same_rays(image.sensor, sensor):
        raise ValueError(f"expected an image of {sensor.name}'s beams, found one of {image.sensor.name}'s; "
                         "complete its points (`image.to_scan()`)")  # fmt: skip
    return image


def sensor_that_made(scan: Scan, sensor_in: Sensor | str | None) -> Sensor:
    """The given sensor, or as recognised from the points. Raises ValueError when it is not."""
    if sensor_in is None:
        sensor_in, reason = recognise(scan)
        if sensor_in is None:
            raise ValueError(reason.replace("--sensor", "--from, or sensor_in"))
        return as_scanned(scan, get_sensor(sensor_in))
    return get_sensor(sensor_in)


def sparse_image(scan: Scan, sensor_in: Sensor, sensor: Sensor) -> tuple[RangeImage, np.ndarray]:
    """A scan of `sensor_in` in the image of `sensor`, and which pixels it looked at: (H, W) bool.

    A pixel was looked at where it was measured, and, empty, where the nearest beam of `sensor_in` reported no return
    in that direction; and, empty, wherever `sensor_in` never looks, whatever the beam, as behind one that looks ahead.
    Raises ValueError when no point falls into the image.
    """
    image = check_seen(project(replace(scan, ring=None), sensor, "spherical"), len(scan))
    own = project(scan, sensor_in, "auto", width=sensor.width)
    gap = np.abs(np.subtract.outer(np.asarray(sensor_in.elevations), np.asarray(sensor.elevations)))  # (H_in, H)
    # A beam that hardly returned anything may not have been there: of every fourth ring of an HDL-64E, 16 were.
    beams = np.flatnonzero((gap.min(axis=1) < 0.5) & (own.mask.mean(axis=1) > 0.02))
    known = image.mask.copy()
    # A beam of fewer returns a turn than columns leaves gaps: empty is what has no return within two columns.
    answered = np.any([np.roll(own.mask, shift, axis=1) for shift in range(-2, 3)], axis=0)
    for beam in beams:
        known[gap[beam].argmin()] |= ~answered[beam]
    middles = (np.arange(sensor.width) + 0.5) / sensor.width
    known |= sensor_in.blocked_rays()[:, (middles * sensor_in.width).astype(int)].all(axis=0)
    return image, known


def with_known(filled: RangeImage, image: RangeImage, known: np.ndarray, keep_reflectance: bool) -> RangeImage:
    """The filled image with every known pixel replaced by its measurement, bit by bit, of the sensor that measured.
    What was filled in before stays so, with the confidence that it had."""
    measured = known & image.mask
    mask = np.where(known, image.mask, filled.mask)
    reflectance = np.where(known & keep_reflectance, image.reflectance, filled.reflectance)
    points = _points(image, filled, measured)
    before = np.zeros_like(mask) if image.new is None else measured & image.new
    said = np.float32(1) if image.confidence is None else np.where(before, image.confidence, np.float32(1))
    sure = None if filled.confidence is None else np.where(known, said, filled.confidence)
    return RangeImage(
        range=np.where(known, np.where(image.mask, image.range, np.float32(0)), filled.range).astype(np.float32),
        reflectance=np.where(mask, reflectance, 0).astype(np.float32),
        mask=mask,
        sensor=image.sensor,
        label=None if filled.label is None else np.where(mask, filled.label, 0),
        xyz=points,
        confidence=sure,
        new=np.where(known, before, mask),
    )


def with_own_classes(filled: RangeImage, image: RangeImage) -> RangeImage:
    """The filled image, where its pixels that `image` has measured keep the classes that they have there, if any."""
    if image.label is None:
        return filled
    others = 0 if filled.label is None else filled.label
    return replace(filled, label=np.where(image.mask, image.label, others))


def _points(image: RangeImage, filled: RangeImage, measured: np.ndarray) -> np.ndarray | None:
    """(H, W, 3) points of measured pixels and of filled ones, where either image has its own; 0 where it has none."""
    if image.xyz is None and filled.xyz is None:
        return None
    own, new = (np.float32(0) if of.xyz is None else of.xyz for of in (image, filled))
    return np.where(measured[..., None], own, np.broadcast_to(new, (*measured.shape, 3)))
