"""What a model has to say of a scan before it works on it: warnings of one line."""

from __future__ import annotations

import warnings
from typing import TYPE_CHECKING, Any, ClassVar, Protocol, TypeAlias

import numpy as np

from lidarsynth.experiment.record import Experiment
from lidarsynth.lidar.plural import plural
from lidarsynth.lidar.recognition import lies_on, recognise, same_kind
from lidarsynth.lidar.scan import RangeImage, Scan, as_scan, check_image
from lidarsynth.lidar.sensor import Sensor, get_sensor
from lidarsynth.lidar.unseen import SPARSE, caution, few_beams
from lidarsynth.lidar.view import beyond_beams, out_of_view

if TYPE_CHECKING:  # `project` needs no torch
    from torch import Tensor

Points: TypeAlias = "Scan | np.ndarray | Tensor"  # that a model is given: a scan, or (N, 3) or (N, 4), on any device
FEWEST = 3  # beams of which a cascade errs about as bilinear interpolation does, of four a quarter less
IN_PYTHON = ", or take model.into(sensor)"  # beside the command line's option, which the reason names


class Knows(Protocol):
    """What a model says of itself; see `ScanModel`."""

    sensor: Sensor
    experiment: Experiment
    any_sensor: ClassVar[bool]


def taken(points: Points) -> Scan:
    """The points as a scan. Raises ValueError as `lidar.scan.as_scan`."""
    from lidarsynth.networks.tensors import as_array

    return as_scan(as_array(points))


def noted(
    model: Knows, scan: Any, sensor: Sensor | str | None = None, filling: bool = False, beams: bool = False
) -> Any:
    """The scan or image, or an array or tensor as a scan, with a warning of what should be known of the result.

    sensor   that made the scan, None = recognised
    filling  whether points are to be added
    beams    whether these are of beams more, as of `upsample`
    """
    scan = scan if isinstance(scan, RangeImage) else taken(scan)
    if isinstance(scan, RangeImage):
        check_image(scan)
    else:
        if (text := stranger(model, scan, sensor)) is not None:
            warnings.warn(f'{model.experiment.name} {text}; use load("default")', stacklevel=3)
        if (text := displaced(model, scan, sensor)) is not None:
            warnings.warn(text, stacklevel=3)
        known = None if sensor is None else get_sensor(sensor)
        if (text := hardly_told(model, scan, sensor)) is not None:
            warnings.warn(text, stacklevel=3)
        image = model.sensor if bound(model) else None
        if filling and (text := caution(scan, known, image=image, around=not beams or bound(model))) is not None:
            warnings.warn(text, stacklevel=3)
    return scan


def hardly_told(model: Knows, scan: Scan, sensor: Sensor | str | None = None) -> str | None:
    """That points lie on so few beams, or that the sensor that is said to have made them has so few, that what is made
    of them is a guess, in one line; or None. Interpolation has learned nothing of beams."""
    own = get_sensor(sensor) if sensor is not None else model.sensor if bound(model) else None
    if own is None or own.height >= FEWEST or len(scan) < SPARSE or model.experiment.model.network != "cascade":
        return few_beams(scan.xyz, own)
    return (f"expected a sensor of {FEWEST} beams and more, found one of {plural(own.height, 'beam')}: in streets of "
            "one or two ranges that are filled in err 4 and 2 times as much as by interpolation (the model bilinear), "
            "and four classes in ten are right")  # fmt: skip


def bound(model: Knows) -> bool:
    """Whether images are of the model's sensor, whatever made the scans, as after `into` or of a model of one alone."""
    return not model.any_sensor or model.experiment.data.fixed


def beyond_image(model: Knows, scan: Scan) -> str | None:
    """That points are above or below the view of the sensor in whose image a model draws a scan of any, and how many;
    or None, as until `into`, where it is the scan's own."""
    return beyond_beams(scan.xyz, model.sensor) if bound(model) else None


def displaced(model: Knows, scan: Scan, sensor: Sensor | str | None = None) -> str | None:
    """That points which are no known sensor's are out of the view of the one that was named for them, here or by
    `into`; or None. Those of a known one are another's, and as they should be."""
    if not len(scan) or (sensor is None and not (model.any_sensor and model.experiment.data.fixed)):
        return None
    own = model.sensor if sensor is None else get_sensor(sensor)
    found = out_of_view(scan.xyz, own)
    if found is None or recognise(scan)[0] is not None:
        return None
    return f"expected points of {own.name} in its frame (x forward, z up, it at the origin), found {found}"


def made_by(scan: Scan | RangeImage, sensor: Sensor | str | None) -> tuple[Scan, Sensor | str | None]:
    """The points of a scan or image, and the sensor that made them: of an image its own, unless one is named; None = to
    be recognised."""
    if isinstance(scan, Scan):
        return scan, sensor
    return scan.to_scan(), scan.sensor if sensor is None else sensor


def stranger(model: Knows, scan: Scan, sensor: Sensor | str | None = None) -> str | None:
    """What a model that knows one sensor alone, or was tuned to one, has to say of another's scan, or None."""
    own = model.experiment.card.sensor if model.any_sensor else model.sensor.name
    if not own:
        return None
    name = recognise(scan)[0] if sensor is None else sensor if isinstance(sensor, str) else sensor.name
    if name is None or same_kind(name, own) or (model.sensor.name == own and lies_on(scan, model.sensor)):
        return None
    knows = f"was tuned to {own}" if model.any_sensor else f"knows {own} alone"
    return f"{knows}, and this is a scan of {name}"


def elsewhere(model: Knows) -> str | None:
    """What a model that was tuned to one sensor has to say where it is asked for images of another, or None."""
    own = model.experiment.card.sensor if model.any_sensor else ""
    if not own or same_kind(model.sensor.name, own):
        return None
    return f"was tuned to {own}, and {model.sensor.name} is another"
