"""The two forms of one LiDAR turn: `Scan` (points in the sensor frame) and `RangeImage` (what the networks see)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING

import numpy as np

from lidarsynth.lidar.boxes import Box, counted
from lidarsynth.lidar.sensor import Sensor, get_sensor

ODD = (np.ma.MaskedArray, np.matrix)  # arrays that do not compute as others do
MEDIAN = 250.0  # metres: no turn has half of its returns beyond it, one in centimetres has
NEAREST, ALMOST, SOME = 0.1, 0.95, 8  # metres: no sensor's returns are almost all nearer; share of them; so many tell
RINGS = 1 << 20  # rings are counted by their numbers, which need not follow one another
_UNKNOWN = np.zeros(0, np.float32)  # stands for a reflectance that is not given


@dataclass(frozen=True, eq=False)
class Scan:
    """N points in the sensor frame: x forward, y left, z up.

    xyz          (N, 3) float32, metres
    reflectance  (N,)   float32 in [0, 1]; 0 where it is not given
    ring         (N,)   int, beam number counted from the top (row 0 is the highest beam), or None
    time         (N,)   float, seconds relative to any fixed instant, or None
    label        (N,)   int, SemanticKITTI training class 0-19, or None
    extra        further fields of the file by name, each (N,), such as ambient or return_type; `new` is 1 for a point
                 that was filled in, 0 for a measured one; `confidence` as in `RangeImage`, 1 for a measured one

    Numbers of other types become float32, whole ones of a ring or label that are floating become int. Raises ValueError
    when a shape does not fit, and for what is no array of numbers, or of whole ones.
    """

    xyz: np.ndarray
    reflectance: np.ndarray = field(default_factory=lambda: _UNKNOWN)
    ring: np.ndarray | None = None
    time: np.ndarray | None = None
    label: np.ndarray | None = None
    extra: Mapping[str, np.ndarray] = field(default_factory=dict)

    def __post_init__(self):
        object.__setattr__(self, "xyz", _numbers("xyz", self.xyz))
        if self.xyz.ndim != 2 or self.xyz.shape[1] != 3:
            raise ValueError(f"xyz must be (N, 3), got {self.xyz.shape}")
        given = None if self.reflectance is _UNKNOWN else self.reflectance
        light = np.zeros(len(self.xyz), np.float32) if given is None else _numbers("reflectance", given)
        object.__setattr__(self, "reflectance", light)
        if not isinstance(self.extra, Mapping) or not all(isinstance(name, str) for name in self.extra):
            raise ValueError(f"extra: expected arrays by name, found {self.extra!r:.60}".partition("\n")[0])
        own = {name: getattr(self, name) for name in ("reflectance", "ring", "time", "label")}
        for name, value in [*own.items(), *self.extra.items()]:
            if value is not None and np.shape(value) != (len(self.xyz),):
                raise ValueError(f"{name} must be ({len(self.xyz)},) like xyz, got {np.shape(value)}")
            if value is not None and not isinstance(value, np.ndarray):
                raise ValueError(f"{name} must be an array, got a {type(value).__name__}")
        for name in ("ring", "label"):
            if own[name] is not None:
                object.__setattr__(self, name, _whole(name, own[name]))
        if self.ring is not None and (most := self.ring.max(initial=0)) >= RINGS:
            raise ValueError(f"ring: expected numbers of beams below {RINGS}, found {most}")
        if self.time is not None:
            _check_numbers("time", self.time)

    def __len__(self) -> int:
        return len(self.xyz)

    def __repr__(self) -> str:
        """One line: how many points, how far away, and which fields."""
        far = np.linalg.norm(self.xyz, axis=1)
        has = [name for name in ("ring", "time", "label") if getattr(self, name) is not None]
        has = ["reflectance"] * bool(self.reflectance.any()) + has
        has += [f"file_{name}" if name in has else str(name) for name in self.extra]  # as they are written
        return f"Scan({', '.join([f'{len(self):,} points{_span(far)}', *has])})"

    __iter__ = None  # a scan is no sequence of points

    def __getitem__(self, index: np.ndarray | Sequence[int] | slice) -> Scan:
        """The scan of the chosen points: a boolean mask (N,), integer indices or a slice."""
        if not isinstance(index, slice) and np.ndim(index) != 1:
            raise IndexError(f"expected a mask, indices or a slice of points, found {index!r}")
        own = (self.xyz, self.reflectance, self.ring, self.time, self.label)
        chosen = [None if values is None else _chosen(values, index) for values in own]
        return Scan(*chosen, {name: _chosen(values, index) for name, values in self.extra.items()})  # type: ignore[arg-type]


def _check_numbers(name: str, values: np.ndarray) -> None:
    """Raises ValueError for what is no array, is masked or a matrix, or has no numbers."""
    if not isinstance(values, np.ndarray) or isinstance(values, ODD):
        raise ValueError(f"{name}: expected an array of numbers, found a {type(values).__name__}")
    if values.dtype.kind not in "fiu":
        raise ValueError(f"{name}: expected an array of numbers, found one of {values.dtype}")


def _numbers(name: str, values: np.ndarray) -> np.ndarray:
    """The array as float32. Raises ValueError as `_check_numbers`."""
    _check_numbers(name, values)
    return values if values.dtype == np.float32 else values.astype(np.float32)


def _whole(name: str, values: np.ndarray) -> np.ndarray:
    """The array with whole numbers as int. Raises ValueError for others, NaN and text."""
    _check_numbers(name, values)
    if values.dtype.kind == "i" or (values.dtype.kind == "u" and values.dtype.itemsize < 8):
        return values
    other = ~((np.abs(values) < 2**53) & (np.floor(values) == values)) if values.dtype.kind == "f" else values >= 2**63
    if other.any():
        raise ValueError(f"{name}: expected whole numbers, found {values[other][0]}")
    return values.astype(np.int64)


def _span(metres: np.ndarray) -> str:
    """The least and largest of metres, in words; nothing of none, and NaN where one is."""
    return f", {metres.min():.1f} to {metres.max():.1f} m" if len(metres) else ""


def _chosen(values: np.ndarray, index: np.ndarray | Sequence[int] | slice) -> np.ndarray:
    """values[index], by `take`, which is several times as fast."""
    if isinstance(index, slice):
        return values[index]
    index = np.asarray(index)
    index = index if len(index) else index.astype(np.intp)
    if index.dtype != np.bool_:
        return values.take(index, axis=0)
    return values.take(np.flatnonzero(index), axis=0) if len(index) == len(values) else values[index]


def as_scan(points: Scan | np.ndarray) -> Scan:
    """A scan as it is, an array as `scan_of` takes it. Raises ValueError for anything else, and as `scan_of` for points
    that are not finite, ranges that are no metres and reflectances in another scale."""
    if isinstance(points, Scan):
        _check(points.xyz, points.reflectance)
        return points
    if not isinstance(points, np.ndarray) or isinstance(points, ODD):
        raise ValueError(f"expected a scan or an array of points, found a {type(points).__name__}")
    return scan_of(points)


def no_metres(far: np.ndarray) -> str:
    """Why distances (N,), 0 = no return, are none of one turn, or '': half of them are farther than any sensor's, or
    almost all nearer."""
    returns = far[far > 0]
    if returns.size >= SOME and (most := float(np.quantile(returns, ALMOST))) < NEAREST:
        return (
            f"expected metres from the sensor, found almost all points {most:.2g} and less away: are they kilometres?"
        )
    if not returns.size or (half := float(np.median(returns))) <= MEDIAN:
        return ""
    return (f"expected metres from the sensor, found half of the points {half:.0f} and more away: are they "
            "centimetres, millimetres or coordinates of a map?")  # fmt: skip


def scan_of(points: np.ndarray) -> Scan:
    """The scan of an array (N, 3) x y z in metres, or (N, 4) with a reflectance of 0 to 1.

    Raises ValueError for another shape, ranges that are no metres, or a reflectance in another scale.
    """
    if points.dtype.names:
        raise ValueError("expected points of (N, 3) x y z or (N, 4) x y z reflectance, found the named fields "
                         f"{', '.join(points.dtype.names)}: Scan(xyz, reflectance, ring) takes each alone")  # fmt: skip
    if points.ndim != 2 or points.shape[1] not in (3, 4) or points.dtype.kind not in "fiu":
        raise ValueError(f"expected points of (N, 3) x y z or (N, 4) x y z reflectance, found {points.shape} of "
                         f"{points.dtype}")  # fmt: skip
    xyz = np.ascontiguousarray(points[:, :3], np.float32)
    light = points[:, 3].astype(np.float32) if points.shape[1] > 3 else np.zeros(len(xyz), np.float32)
    _check(xyz, light, " in the fourth column")
    return Scan(xyz, light)


def least_confidence(least: float) -> float:
    """The number as Python's own. Raises ValueError for one outside 0 to 1, and for what is no number."""
    try:
        number = None if isinstance(least, str | bytes) else float(least)
    except (TypeError, ValueError, RuntimeError):
        number = None
    if number is None or not 0 <= number <= 1:
        found = f"{least!r:.60}" if number is None else f"{number:g}"
        raise ValueError(f"expected a least confidence of 0 to 1, found {found}")
    return number


def check_image(image: RangeImage) -> None:
    """Raises ValueError for measured ranges that are negative or not finite, and reflectances outside 0 to 1."""
    metres, light = (values[image.mask] for values in (image.range, image.reflectance))
    if not (metres.min(initial=0) >= 0 and metres.max(initial=0) < np.inf):
        raise ValueError(f"expected ranges in metres, finite and not negative, found {metres.min():g} to "
                         f"{metres.max():g}")  # fmt: skip
    if not (light.min(initial=0) >= 0 and light.max(initial=0) <= 1):
        raise ValueError(f"expected a reflectance of 0 to 1, found {light.min():g} to {light.max():g}; divide it by "
                         "its scale")  # fmt: skip


def with_points(scan: Scan, where: str = "") -> Scan:
    """The scan. Raises ValueError, which begins with `where` it is from, where it holds no point."""
    if not len(scan):
        raise ValueError(f"{where}{': ' if where else ''}expected points, found a scan of none")
    return scan


def check_seen(image: RangeImage, count: int) -> RangeImage:
    """The image of `count` points. Raises ValueError where it has none of them."""
    if not image.mask.any():
        raise ValueError(f"expected points within {image.sensor.name}'s view, found none of {count} points")
    return image


def _check(xyz: np.ndarray, light: np.ndarray, where: str = "") -> None:
    if not np.isfinite(xyz).all():
        raise ValueError("expected finite points, found NaN or infinite ones; leave them out")
    if text := no_metres(np.abs(xyz[::16]).max(axis=1, initial=0)):
        raise ValueError(text)
    if np.isnan(light.max(initial=0)):
        raise ValueError(f"expected a reflectance of 0 to 1{where}, found NaN; put 0 where nobody knows it")
    if not (light.min(initial=0) >= 0 and light.max(initial=0) <= 1):
        raise ValueError(f"expected a reflectance of 0 to 1{where}, found {light.min():g} to {light.max():g}; divide "
                         "it by its scale")  # fmt: skip


@dataclass(frozen=True, eq=False)
class RangeImage:
    """One turn as an equirectangular image; row 0 is the highest beam, column 0 looks backwards (+180 degrees).

    range        (H, W) float32, metres, 0 where nothing returned
    reflectance  (H, W) float32 in [0, 1], 0 where nothing returned
    mask         (H, W) bool, True where measured
    sensor       gives every pixel's ray angles; a word becomes the sensor it stands for
    label        (H, W) int, SemanticKITTI training class, 0 where nothing returned, or None
    xyz          (H, W, 3) float32, metres: the measured points themselves where the image came from a scan, or None
    completed    every point of the scan that was completed to this image, bit by bit, with the new ones, or None
    confidence   (H, W) float32 in [0, 1]: of a filled pixel the estimated chance that its ray returns, and from no
                 farther than 0.3 m + 2 % from the pixel's range; 1 where measured. None where the model gives none
    new          (H, W) bool: of a completed image, which of its pixels were filled in, now or before; or None
    surface      (H, W) float32, metres: of virtual streets, where exactly each ray meets something, whether it returned
                 or not, 0 for nothing; or None. It is not saved
    instance     (H, W) int: of generated images with classes, the number of the box that a return is of, 0 for none; or
                 None
    boxes        of these, in the sensor frame. They are not saved

    Points of the image are `xyz` where it has them, and of a completed scan `completed`: who changes `range` alone
    changes neither. Numbers of other types become float32. Raises ValueError when a shape does not fit, for a mask that
    is not bool, and for measured pixels whose range is not finite and above 0 (a sensor that sees from 0 m on may
    measure 0).
    """

    range: np.ndarray
    reflectance: np.ndarray
    mask: np.ndarray
    sensor: Sensor
    label: np.ndarray | None = None
    xyz: np.ndarray | None = None
    completed: Scan | None = None
    confidence: np.ndarray | None = None
    surface: np.ndarray | None = None
    new: np.ndarray | None = None
    instance: np.ndarray | None = None
    boxes: tuple[Box, ...] = ()

    if TYPE_CHECKING:  # the dataclass's own, but that a word may stand for a sensor

        def __init__(
            self, range: np.ndarray, reflectance: np.ndarray, mask: np.ndarray, sensor: Sensor | str,
            label: np.ndarray | None = None, xyz: np.ndarray | None = None, completed: Scan | None = None,
            confidence: np.ndarray | None = None, surface: np.ndarray | None = None, new: np.ndarray | None = None,
            instance: np.ndarray | None = None, boxes: tuple[Box, ...] = (),
        ) -> None: ...  # fmt: skip

    def __post_init__(self):
        object.__setattr__(self, "sensor", get_sensor(self.sensor))
        shape = (self.sensor.height, self.sensor.width)
        for name in ("range", "reflectance", "mask", "label", "confidence", "surface", "new", "instance"):
            value = getattr(self, name)
            if value is not None and not isinstance(value, np.ndarray):
                raise ValueError(f"{name} must be an array, got a {type(value).__name__}")
            if value is not None and value.shape != shape:
                raise ValueError(f"{name} must be {shape}, the sensor's beams and columns, got {value.shape}")
        for name, marked in (("mask", self.mask), ("new", self.new)):
            if marked is not None and marked.dtype != np.bool_:
                raise ValueError(f"{name} must be bool, got {marked.dtype}")
        if self.xyz is not None and np.shape(self.xyz) != (*shape, 3):
            raise ValueError(f"xyz must be {(*shape, 3)}, got {np.shape(self.xyz)}")
        for name in ("range", "reflectance", "xyz", "confidence", "surface"):
            if (value := getattr(self, name)) is not None:
                object.__setattr__(self, name, _numbers(name, value))
        for name in ("label", "instance"):
            if (value := getattr(self, name)) is not None:
                _whole(name, value)
        if not isinstance(self.completed, Scan | None):
            raise ValueError(f"completed must be a Scan, got a {type(self.completed).__name__}")
        self._check_ranges()

    def _check_ranges(self) -> None:
        above = np.greater if self.sensor.min_range else np.greater_equal
        good = above(self.range, 0)
        good &= self.range < np.inf
        if np.greater(self.mask, good).any():
            found = self.range[self.mask & ~good][0]
            raise ValueError(f"expected ranges of measured pixels in metres, finite and above 0, found {found:g}")

    def __repr__(self) -> str:
        """One line: sensor, size, how many pixels are measured, how far away, and what else there is."""
        has = ["reflectance"] * bool(self.reflectance.any())
        more = ("label", "xyz", "completed", "confidence", "surface", "new", "instance")
        has += [name for name in more if getattr(self, name) is not None]
        count = f"{np.count_nonzero(self.mask):,} measured{_span(self.range[self.mask])}"
        return f"RangeImage({', '.join([self.sensor.name, '{} x {}'.format(*self.shape), count, *has])})"

    @property
    def shape(self) -> tuple[int, int]:
        return self.sensor.height, self.sensor.width

    def points(self) -> np.ndarray:
        """(H, W, 3) float32, metres: measured points where the image has them, else range along each pixel's ray."""
        rays = self.sensor.points(self.range)
        if self.xyz is None:
            return rays
        return np.where(np.any(self.xyz != 0, axis=-1, keepdims=True), self.xyz, rays)

    def to_scan(self) -> Scan:
        """The measured pixels as points, row by row from the top, `ring` the row; of a completed scan, `completed`."""
        if self.completed is not None:
            return self.completed
        chosen = np.flatnonzero(self.mask)
        kept = (self.reflectance, self.label, self.confidence, self.new, self.instance)
        shade, label, sure, new, number = (None if v is None else v.reshape(-1).take(chosen) for v in kept)
        extra = {} if new is None else {"new": new.astype(np.uint8)}
        extra |= {} if sure is None else {"confidence": sure}
        extra |= {} if number is None else {"instance": number.astype(np.int32)}
        assert shade is not None
        return Scan(self._points_of(chosen), shade, chosen // self.sensor.width, None, label, extra)

    def _points_of(self, chosen: np.ndarray) -> np.ndarray:
        """`points()` of pixels (N,) of the flattened image, without the work for all others."""
        rays = self.sensor.points(self.range, chosen)
        if self.xyz is None:
            return rays
        own = self.xyz.reshape(-1, 3).take(chosen, axis=0)
        x, y, z = own.T
        measured = np.flatnonzero((x != 0) | (y != 0) | (z != 0))
        rays[measured] = own[measured]
        return rays

    def surer_than(self, least: float) -> RangeImage:
        """The same image without the filled pixels, and `completed` without the new points, below a confidence.

        Raises ValueError for a `least` outside 0 to 1, and where the model gave no confidence.
        """
        least = least_confidence(least)
        if self.confidence is None:
            raise ValueError("expected a completion with confidences, such as default's, found one without")
        points = self.completed
        if points is not None:
            points = points[points.extra["confidence"] >= least]
        return replace(self.keep(self.confidence >= least), completed=points)

    def keep(self, known: np.ndarray) -> RangeImage:
        """The same image with every pixel outside `known` (H, W) bool emptied, as points too: `completed` is gone."""
        if known.shape != self.shape:
            raise ValueError(f"known must be {self.shape}, got {known.shape}")
        mask = self.mask & known
        label, number = (None if part is None else np.where(mask, part, 0) for part in (self.label, self.instance))
        xyz = None if self.xyz is None else np.where(mask[..., None], self.xyz, np.float32(0))
        zero = np.float32(0)
        return replace(
            self,
            range=np.where(mask, self.range, zero),
            reflectance=np.where(mask, self.reflectance, zero),
            mask=mask,
            label=label,
            xyz=xyz,
            completed=None,
            confidence=None if self.confidence is None else np.where(mask, self.confidence, zero),
            new=None if self.new is None else mask & self.new,
            instance=number,
            boxes=self.boxes if number is None else counted(self.boxes, number),
        )


def laid_out(array: np.ndarray, dtype: np.dtype | type | None = None) -> np.ndarray:
    """The array as torch takes it, a copy where it has to be: in C order, writable, and no axis backwards, which numpy
    passes over where one of length 1 is."""
    array = np.require(array, dtype, ["C", "W"])
    return array.copy() if min(array.strides, default=0) < 0 else array
