"""lidarsynth generates, completes and judges spinning-LiDAR scans.

The public names load what they need when first used, so that `import lidarsynth` is instant.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from lidarsynth.evaluation.evaluate import evaluate
    from lidarsynth.files.formats import read, read_image, write
    from lidarsynth.lidar.corruption import corrupt
    from lidarsynth.lidar.projection import project
    from lidarsynth.lidar.scan import RangeImage, Scan
    from lidarsynth.lidar.sensor import SENSORS, Sensor, get_sensor, read_sensor
    from lidarsynth.systems.diffusion.model import LidarModel
    from lidarsynth.systems.scan_model import ScanModel
    from lidarsynth.weights.load import load

__version__ = "0.1.0"

_HOME = {
    "read": "lidarsynth.files.formats",
    "read_image": "lidarsynth.files.formats",
    "write": "lidarsynth.files.formats",
    "evaluate": "lidarsynth.evaluation.evaluate",
    "corrupt": "lidarsynth.lidar.corruption",
    "project": "lidarsynth.lidar.projection",
    "RangeImage": "lidarsynth.lidar.scan",
    "Scan": "lidarsynth.lidar.scan",
    "SENSORS": "lidarsynth.lidar.sensor",
    "Sensor": "lidarsynth.lidar.sensor",
    "get_sensor": "lidarsynth.lidar.sensor",
    "read_sensor": "lidarsynth.lidar.sensor",
    "LidarModel": "lidarsynth.systems.diffusion.model",
    "ScanModel": "lidarsynth.systems.scan_model",
    "load": "lidarsynth.weights.load",
}

__all__ = [
    "SENSORS",
    "LidarModel",
    "RangeImage",
    "Scan",
    "ScanModel",
    "Sensor",
    "corrupt",
    "evaluate",
    "get_sensor",
    "load",
    "project",
    "read",
    "read_image",
    "read_sensor",
    "write",
]


def __getattr__(name: str) -> Any:
    if name not in _HOME:
        raise AttributeError(f"module 'lidarsynth' has no attribute {name!r}")
    return getattr(import_module(_HOME[name]), name)


def __dir__() -> list[str]:
    return sorted([*globals(), *_HOME])
