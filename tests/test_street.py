"""street-1: the shipped network is the frozen one, needs no download, and worse scans get worse scores."""

import json
import sys
from collections.abc import Iterator
from dataclasses import replace
from hashlib import sha256
from pathlib import Path

import numpy as np
import pytest
import torch

import lidarsynth as ls
from lidarsynth import gathering
from lidarsynth.cli import main
from lidarsynth.data.files import write
from lidarsynth.gathering import load_networks
from lidarsynth.lidar.scan import RangeImage
from lidarsynth.lidar.sensor import SENSORS
from lidarsynth.metrics.distributions import frechet_distance, moments
from lidarsynth.metrics.protocols import STREET_1, get_protocol
from lidarsynth.metrics.rangenet import RangeNet
from lidarsynth.metrics.statistics import Statistics, definition
from lidarsynth.metrics.street import FEATURES, StreetFeatures
from lidarsynth.training.segmentation import confusion, pixels
from lidarsynth.weights import load_parts, shipped

REPO_ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(REPO_ROOT / "benchmarks"))  # the corruptions that docs/street-1.md measures
SENSOR = SENSORS["hdl-64e-kitti"]
pytest.importorskip("embreex", reason="lidarsynth[synthetic] is not installed")
