"""Range images that others made: arrays of points in rows and columns, empty pixels as their programs leave them."""

from pathlib import Path

import numpy as np
import pytest

from lidarsynth.cli.main import main
from lidarsynth.files.fields import scan_from_fields
from lidarsynth.files.formats import read_with_report
from lidarsynth.lidar.recognition import recognise
from lidarsynth.lidar.sensor import get_sensor


def channels(empty: float) -> np.ndarray:
    """(64, 512, 5) x y z remission range of a wall all around `hdl-64e-kitti`, empty pixels as told."""
    sensor = get_sensor("hdl-64e-kitti").resized(width=512)
    xyz = sensor.points(np.full((64, 512), 12.0, np.float32))
    image = np.concatenate([xyz, np.full((64, 512, 1), 0.3), np.linalg.norm(xyz, axis=2, keepdims=True)], axis=2)
    image[::3, ::5] = empty
    return image.astype(np.float32)


@pytest.mark.parametrize("empty", [0.0, -1.0, np.nan])
@pytest.mark.parametrize("ending", ["npy", "npz"])
def test_empty_pixels_are_no_points(tmp_path: Path, empty: float, ending: str):
    path, image = tmp_path / f"a.{ending}", channels(empty)
    if ending == "npy":
        np.save(path, image)
    else:
        np.savez(path, xyz=image[..., :3], reflectance=image[..., 3], range=image[..., 4])
    scan, dropped = read_with_report(path)
    assert dropped == 22 * 103 and len(scan) == 64 * 512 - dropped
    assert np.linalg.norm(scan.xyz, axis=1).min() > 11 and scan.reflectance == pytest.approx(0.3)
    assert (scan.ring is not None) == (ending == "npz") and recognise(scan)[0] == "hdl-64e-kitti"


def test_a_single_point_may_lie_there():
    fields = {name: np.array([-1, 5, 7], np.float32) for name in "xyz"} | {"intensity": np.full(3, 0.5, np.float32)}
    assert len(scan_from_fields(fields)[0]) == 3


def test_info_says_why_there_is_no_reflectance(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    image = channels(0)
    image[..., 3] -= 0.5
    np.save(tmp_path / "a.npy", image)
    main(["info", str(tmp_path / "a.npy")])
    assert "reflectance  expected an intensity of 0-1 (unit), found -0.2 to -0.2" in capsys.readouterr().out
