"""E57 files: what pye57 wrote comes back in the scanner's frame; several scans and broken files are refused."""

from pathlib import Path

import numpy as np
import pytest

from lidarsynth.files.formats import read

pye57 = pytest.importorskip("pye57", reason="the extra data is not installed")


def columns(count: int = 500) -> dict[str, np.ndarray]:
    rng = np.random.default_rng(0)
    points = {f"cartesian{axis}": rng.uniform(2, 40, count) for axis in "XYZ"}
    return points | {
        "intensity": rng.random(count).astype(np.float32),
        "rowIndex": np.arange(count, dtype=np.int32) % 9,
        "columnIndex": np.arange(count, dtype=np.int32) // 9,
    }


def written(path: Path, *scans: dict[str, np.ndarray]) -> Path:
    file = pye57.E57(str(path), mode="w")
    for scan in scans:
        file.write_scan_raw(scan, rotation=np.array([0.0, 1, 0, 0]), translation=np.array([100.0, 0, 0]))
    file.close()
    return path


def test_points_come_back_in_the_scanners_frame_without_the_invalid_ones(tmp_path: Path):
    made = columns()
    invalid = np.arange(500) % 5 == 0
    scan = read(written(tmp_path / "a.e57", made | {"cartesianInvalidState": invalid.astype(np.int32)}))
    expected = np.stack([made[f"cartesian{axis}"] for axis in "XYZ"], 1)[~invalid]
    np.testing.assert_allclose(scan.xyz, expected, atol=1e-5)
    np.testing.assert_allclose(scan.reflectance, made["intensity"][~invalid], atol=1e-6)
    np.testing.assert_array_equal(scan.extra["row"], made["rowIndex"][~invalid])


def test_several_scans_and_broken_files_are_refused(tmp_path: Path):
    with pytest.raises(ValueError, match="expected an E57 file of one scan, found 2"):
        read(written(tmp_path / "two.e57", columns(), columns()))
    whole = written(tmp_path / "one.e57", columns()).read_bytes()
    broken = {
        "short": whole[:3000],
        "text": b"hello" * 100,
        "changed": whole[:2000] + bytes(200) + whole[2200:],
        "empty": whole[:48] + bytes(len(whole) - 48),
    }
    for name, data in broken.items():
        path = tmp_path / f"{name}.e57"
        path.write_bytes(data)
        with pytest.raises(ValueError, match=rf"{name}\.e57: expected .*, found") as error:
            read(path)
        assert "\n" not in str(error.value)
