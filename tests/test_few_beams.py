"""Points on hardly any beams of the sensor that is named are told, also where `--rings` takes them of others."""

import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from lidarsynth.cli.main import main
from lidarsynth.files.formats import write
from lidarsynth.lidar.scan import Scan
from lidarsynth.lidar.sensor import SENSORS, Sensor, get_sensor
from lidarsynth.lidar.unseen import few_beams
from lidarsynth.lidar.view import misfit, placement
from lidarsynth.streets.reader import SyntheticStreets
from lidarsynth.systems.notes import hardly_told
from lidarsynth.weights.load import load


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


@pytest.mark.parametrize("kept", [slice(6, 15), slice(0, 16, 2)])
def test_some_beams_of_a_named_sensor_are_no_other_sensors(kept: slice):
    """Beams two degrees apart are on those of a Pandar64, too, which is recognised of some."""
    scan = street("vlp-16")
    some = scan[np.isin(scan.ring, np.arange(16)[kept])]
    assert placement(some, get_sensor("vlp-16"))[0] is None
    off = Sensor("own", tuple((np.array(SENSORS["vlp-16"].elevations) + 0.7).tolist()))
    assert "found them on" in str(placement(some, off)[0])


SAID = "points on many beams, found nearly all at {}: nothing tells what is above and below, so that the result is a"


@pytest.mark.parametrize("name", SENSORS)
def test_scans_of_a_street_have_many_beams_and_two_or_three_are_few(name: str):
    scan = street(name)
    for kept in (scan.ring >= 0, scan.ring % 4 == 0, np.abs(scan.xyz[:, 1]) < 0.2 * scan.xyz[:, 0]):
        assert few_beams(scan.xyz[kept]) is None
    low = scan.ring.max() * 3 // 4
    two = scan.xyz[np.isin(scan.ring, [low // 2, low])]
    assert SAID.format("2 elevations") in str(few_beams(two, get_sensor(name)))
    assert few_beams(scan.xyz[scan.ring == low], Sensor("few", (0.0, -3.0, -6.0))) is None
    assert few_beams(scan.xyz[:0]) is None


@pytest.mark.parametrize("verb", ["complete", "label", "upsample --times 2"])
def test_few_beams_are_told_of_whichever_scan_of_a_folder(verb: str, tmp_path: Path, capsys):
    """Of many scans only some are looked at; a laser's among them was completed without a word."""
    scan, words = street("vlp-16"), ["--no-picture", "--out", str(tmp_path / "out")]
    for i in range(5):
        write(tmp_path / f"{i}.ply", scan[scan.ring % 5 == 3] if i == 4 else scan)
    words += ["--from" if verb.startswith("up") else "--sensor", "vlp-16"]
    main([*verb.split(), str(tmp_path / "[0-4].ply"), *words])
    told = [line for line in capsys.readouterr().err.splitlines() if "many beams" in line]
    assert len(told) == 1 and f"{tmp_path / '4.ply'}: expected {SAID.format('3 elevations')}" in told[0]


HARDLY = r"^expected a sensor of 3 beams and more, found one of {}: .* four classes in ten are right$"


@pytest.mark.parametrize("verb", ["complete", "label"])
def test_a_sensor_of_one_or_two_beams_is_told_to_be_hardly_enough(verb: str, tmp_path: Path, capsys):
    """Such are completed worse than by interpolation, which was not said; it says nothing of itself."""
    (tmp_path / "two.toml").write_text('name = "two"\nwidth = 256\nelevations = [-2.0, -6.0]\n')
    write(tmp_path / "a.ply", SyntheticStreets(5, 1, Sensor("two", (-2.0, -6.0), 256)).image(0).to_scan())
    words = ["--sensor", str(tmp_path / "two.toml"), "--no-picture"]
    for model in ("default", "nearest") if verb == "complete" else ("default",):
        main([verb, str(tmp_path / "a.ply"), *words, "--model", model, "--out", str(tmp_path / f"{model}.ply")])
        said = "expected a sensor of 3 beams and more, found one of 2 beams" in capsys.readouterr().err
        assert said == (model == "default")


@pytest.mark.parametrize("count", [1, 2, 3])
def test_a_model_in_python_tells_of_a_sensor_of_one_or_two_beams(count: int):
    sensor = Sensor("few", (-2.0, -6.0, -9.0)[:count], 256)
    scan, model = SyntheticStreets(5, 1, sensor)[0], load("default").into(sensor)
    text = hardly_told(model, scan)
    assert text is None if count == 3 else re.match(HARDLY.format("1 beam" if count == 1 else "2 beams"), str(text))
    assert hardly_told(load("nearest").into(sensor), scan) is None


def test_a_model_in_python_warns_of_few_beams():
    scan, model = street("vlp-16"), load("nearest").into("vlp-16")
    with pytest.warns(UserWarning, match="nearly all at 1 elevation: nothing tells"):
        model.complete(scan[scan.ring == 12])
