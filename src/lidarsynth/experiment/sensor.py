"""The sensor of an experiment's images."""

from __future__ import annotations

from lidarsynth.experiment.record import Experiment
from lidarsynth.lidar import sensor as sensors
from lidarsynth.lidar.sensor import Sensor


def build_sensor(experiment: Experiment) -> Sensor:
    """The sensor of the experiment's images: its beams thinned to `data.height`, `data.width` columns."""
    given = experiment.data.sensor
    sensor = sensors.from_dict(given) if isinstance(given, dict) else sensors.get_sensor(given)
    return sensor.resized(experiment.data.height, experiment.data.width)
