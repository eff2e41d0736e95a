"""Models of any sensor: each scan is completed in the image of the sensor that made it, until `into` names another."""

from __future__ import annotations

from abc import ABC
from dataclasses import replace
from typing import TYPE_CHECKING, ClassVar

from lidarsynth.experiment.record import Experiment, with_fields
from lidarsynth.lidar.columns import as_scanned, usual_at_most
from lidarsynth.lidar.measured import with_measured
from lidarsynth.lidar.projection import pixel_of_points
from lidarsynth.lidar.recognition import lies_on, recognise
from lidarsynth.lidar.scan import RangeImage, Scan, check_seen
from lidarsynth.lidar.sensor import Sensor, get_sensor, same_rays
from lidarsynth.systems.denser import TIMES, denser, spread
from lidarsynth.systems.filling import Filling, whole
from lidarsynth.systems.known_pixels import with_own_classes
from lidarsynth.systems.notes import IN_PYTHON, Points, taken
from lidarsynth.systems.scan_model import OnStep, ScanModel

if TYPE_CHECKING:
    from typing_extensions import Self


class AnySensorModel(ScanModel, ABC):
    """A frozen record with `sensor` and `experiment`, whose network knows none of them."""

    any_sensor: ClassVar[bool] = True

    @property
    def own(self) -> bool:
        """Whether scans are completed in the images of their own sensors: until `into`."""
        return not self.experiment.data.fixed

    def into(self, sensor: Sensor | str) -> Self:
        """The same model with images of another sensor, or of this one alone."""
        sensor = get_sensor(sensor)
        experiment = imaged_by(self.experiment, sensor, fixed=True)
        return replace(self, sensor=sensor, experiment=experiment)  # type: ignore[type-var]

    def suited_to(self, scan: Scan, sensor: Sensor | str | None = None) -> Self:
        """The model with images of the sensor that made the scan; itself after `into`.

        sensor  None = as recognised from the points; raises ValueError when it is not
        """
        if not self.own:
            return self
        if sensor is None:
            sensor, reason = recognise(scan)
            if sensor is None and lies_on(scan, self.sensor):
                sensor = self.sensor  # the user's own, on which the model was tuned
            if sensor is None:
                raise ValueError(f"{reason}{IN_PYTHON}")
            sensor = as_scanned(scan, get_sensor(sensor))
        return self.into(sensor)

    def labelling(self, scan: Scan) -> Self:
        """`suited_to` a scan that is to be labelled: in no more columns than usual; itself after `into`."""
        return self.into(usual_at_most(self.suited_to(scan).sensor)) if self.own else self

    def suited_to_image(self, image: RangeImage) -> Self:
        """The model with images of this one's rays; itself after `into`."""
        return self.into(image.sensor) if self.own and not same_rays(image.sensor, self.sensor) else self

    def upsampled(
        self,
        scan: Points,
        how: Filling,
        sensor_in: Sensor | str | None = None,
        on_step: OnStep = None,
        times: int | None = None,
    ) -> RangeImage:
        """`upsample` of a record: of the scan's own sensor in `times` as many beams, or, after `into`, of that one.

        Of a scan that holds every k-th beam of its sensor, as many times these: the sensor's own, where that is k.

        `to_scan()` gives every measured point bit by bit beside the new ones.
        """
        if not self.own:
            if times is not None:
                raise ValueError(
                    f"expected times as many beams or images of {self.sensor.name}, found both: for the former, ask a "
                    "model without into, and name the scan's sensor as sensor_in"
                )
            return super().upsampled(scan, how, sensor_in, on_step)
        if how.precision is not None:
            model = self.at_precision(how.precision)
            return model.upsampled(scan, replace(how, precision=None), sensor_in, on_step, times)
        scan, times = taken(scan), TIMES if times is None else whole("times", times)
        own, how = self.suited_to(scan).sensor if sensor_in is None else get_sensor(sensor_in), self.resolved(how)
        sparse = check_seen(self.into(own).image_of(scan), len(scan))
        beams, dense, every = denser(own, sparse, times)
        sparse = sparse if beams == own else self.into(beams).image_of(scan)
        model = self.into(dense)
        image, known = spread(sparse, dense, every)
        filled = with_own_classes(model.fill(image, known, how, on_step), image)
        loose = replace(scan, ring=None)
        pixels = pixel_of_points(loose, filled.sensor, "spherical")
        return replace(filled, completed=with_measured(scan, image.mask, filled, pixels))


def imaged_by(experiment: Experiment, sensor: Sensor, fixed: bool = False) -> Experiment:
    """The experiment with images of another sensor; `fixed`, whatever sensor made the scans."""
    size = {"data.height": sensor.height, "data.width": sensor.width}
    return with_fields(experiment, {"data.sensor": sensor.to_dict(), **size, "data.fixed": fixed})
