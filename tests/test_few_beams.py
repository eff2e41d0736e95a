"""Points on hardly any beams of the sensor that is named are told, also where `--rings` takes them of others."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from lidarsynth.cli.main import main
from lidarsynth.files.formats import write
from lidarsynth.lidar.scan import Scan
from lidarsynth.lidar.sensor import SENSORS, get_sensor
from lidarsynth.lidar.view import misfit, placement
from lidarsynth.streets.reader import SyntheticStreets


def street(name: str) -> Scan:
    return replace(SyntheticStreets(5, 1, get_sensor(name)).image(0).to_scan(), label=None)


@pytest.mark.parametrize(("first", "last"), [(0, 0), (3, 3), (12, 12), (15, 15), (11, 13)])
@pytest.mark.parametrize("rising", [False, True])
def test_a_few_rings_that_are_taken_of_a_sensor_are_told(first: int, last: int, rising: bool, tmp_path: Path, capsys):
    scan = street("vlp-16")
    write(tmp_path / "a.ply", replace(scan, ring=None, extra={"ring": 15 - scan.ring if rising else scan.ring}))
    rings = f"{15 - last}-{15 - first}" if rising else f"{first}-{last}"
    words = ["--sensor", "vlp-16", "--model", "nearest", "--no-picture", "--out", str(tmp_path / "b.ply")]
    main(["complete", str(tmp_path / "a.ply"), "--rings", rings, *words])
    said, few = capsys.readouterr().err, last - first + 1
    lowest = f"none on its {15 - last} lowest beams of 16"
    found = lowest if 15 - last > 4 else f"on {few} of its 16 beams"
    assert f"expected points of vlp-16, found {found}" in said.replace("them on", "on"), said


def test_rings_of_one_of_two_sensors_cover_its_beams(tmp_path: Path, capsys):
    one, other = street("vlp-16"), street("vlp-16")
    rings = np.concatenate([one.ring, other.ring + 16])
    both = Scan(np.concatenate([one.xyz, other.xyz]), np.concatenate([one.reflectance, other.reflectance]))
    write(tmp_path / "a.ply", replace(both, extra={"ring": rings}))
    words = ["--sensor", "vlp-16", "--model", "nearest", "--no-picture", "--out", str(tmp_path / "b.ply")]
    main(["complete", str(tmp_path / "a.ply"), "--rings", "16-31", *words])
    assert "beams" not in capsys.readouterr().err


@pytest.mark.parametrize("name", SENSORS)
def test_whole_and_thinned_scans_are_no_few_beams(name: str):
    scan, sensor = street(name), get_sensor(name)
    low = scan.ring >= sensor.height // 2  # the sky above
    for kept in (scan.ring >= 0, scan.ring % 4 == 0, low, low & (scan.ring % 4 == 0)):
        assert "of its" not in str(misfit(scan.xyz[kept], sensor, scan.ring[kept]))
    assert placement(scan, sensor)[0] is None
