"""What of a user's files is judged, and what is refused or told: other units, copies, files beside scans."""

import json
import shutil
from pathlib import Path

import numpy as np
import pytest
import torch

import lidarsynth as ls
from lidarsynth.cli.main import main
from lidarsynth.evaluation.image_sets import image_set
from lidarsynth.files.formats import read_image, write
from lidarsynth.lidar.scan import RangeImage
from lidarsynth.lidar.sensor import SENSORS

SENSOR = SENSORS["hdl-64e"].resized(width=64)


def street(seed: int) -> RangeImage:
    rng = np.random.default_rng(seed)
    rays = SENSOR.directions()
    with np.errstate(divide="ignore"):
        distance = np.minimum(np.where(rays[..., 2] < 0, -1.7 / rays[..., 2], np.inf), 9 / np.abs(rays[..., 1]))
    mask = (distance < 60) & (rng.random(distance.shape) < 0.9)
    reflectance = (rng.random(mask.shape) * mask).astype(np.float32)
    return RangeImage(np.where(mask, distance, 0).astype(np.float32), reflectance, mask, SENSOR)


@pytest.fixture(autouse=True)
def cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("LIDARSYNTH_CACHE", str(tmp_path / "cache"))


def saved(folder: Path, seeds: range, ending: str = "npz") -> Path:
    folder.mkdir()
    for seed in seeds:
        write(folder / f"{seed}.{ending}", street(seed))
    return folder


def stored(path: Path, **changed: np.ndarray) -> None:
    """The arrays of a street as another program may save them."""
    image = street(3)
    arrays = {"range": image.range, "reflectance": image.reflectance, "mask": image.mask, **changed}
    np.savez(path, sensor=np.array(json.dumps(SENSOR.to_dict())), **arrays)  # type: ignore[arg-type]


def batch(path: Path, seeds: range) -> list[RangeImage]:
    images, keys = [street(seed) for seed in seeds], ("range", "reflectance", "mask")
    stored(path, **{key: np.stack([getattr(image, key) for image in images]) for key in keys})
    return images


def test_a_batch_that_is_written_anew_is_read_anew(tmp_path: Path):
    """Under the stamp of the new file, its statistics would be kept on disk."""
    for seeds in (range(2), range(2, 4)):
        images = batch(tmp_path / "b.npz", seeds)
        found = image_set(tmp_path)
        for i in (0, 1):
            read = found.item(i)
            assert isinstance(read, RangeImage)
            np.testing.assert_array_equal(read.range, images[i].range)


@pytest.mark.parametrize("scale", [100, 1000])
def test_ranges_in_other_units_than_metres_are_refused(scale: int, tmp_path: Path):
    real, folder = saved(tmp_path / "real", range(2)), tmp_path / "other"
    folder.mkdir()
    stored(folder / "a.npz", range=street(3).range * scale)
    with pytest.raises(
        ValueError,
        match=r"a.npz: expected (metres from the sensor, found half of the points|finite range of 0 to 10000, found)",
    ):
        ls.evaluate(folder, real)
    image = street(3)
    tensor = np.stack([image.range, *np.moveaxis(image.points(), -1, 0), image.reflectance])
    tensor[:4] *= scale
    (folder / "a.npz").unlink()
    torch.save(torch.from_numpy(tensor), folder / "a.pth")
    with pytest.raises(ValueError, match=r"a.pth: expected metres from the sensor, found half of the points \d+"):
        ls.evaluate(folder, real)


@pytest.mark.parametrize("protocol", ["bev-1", "street-upsampling-1"])
def test_a_copy_of_the_reference_is_told(protocol: str, tmp_path: Path):
    real = saved(tmp_path / "real", range(2))
    copy = Path(shutil.copytree(real, tmp_path / "copy"))
    other = saved(tmp_path / "other", range(10, 12))
    told = "samples and reference are the same images"
    assert any(told in note for note in ls.evaluate(copy, real, protocol).warnings)
    assert not any(told in note for note in ls.evaluate(other, real, protocol).warnings)


def test_files_beside_scans_are_not_judged(tmp_path: Path):
    folder = saved(tmp_path / "sequence", range(2), "ply")
    (folder / "poses.txt").write_text("1 0 0 0 0 1 0 0 0 0 1 0\n")
    (folder / "labels").mkdir()
    np.zeros(40, "<f4").tofile(folder / "labels" / "0.bin")
    assert len(image_set(folder)) == 2
    assert image_set(folder / "poses.txt").names  # named, it is read


def test_scans_without_reflectance_are_judged_where_that_is_said(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    real, folder = saved(tmp_path / "real", range(2)), tmp_path / "bare"
    folder.mkdir()
    for seed in range(10, 12):
        np.save(folder / f"{seed}.npy", street(seed).to_scan().xyz)
    with pytest.raises(ValueError, match=r"10.npy: expected an intensity field .*--intensity none takes it for 0"):
        ls.evaluate(folder, real)
    words = [
        "evaluate",
        str(folder),
        "--reference",
        str(real),
        "--intensity",
        "none",
        "--out",
        str(tmp_path / "r.json"),
    ]
    assert main(words) in (None, 0) and "JSD" in capsys.readouterr().out
    values = ls.evaluate(folder, real, intensity="none").values
    assert {
        name: row["value"] for name, row in json.loads((tmp_path / "r.json").read_text())["values"].items()
    } == values
    assert values["JSD x1e2"]
    part = tmp_path / "part.safetensors"
    assert (
        main([*words[:2], "--part", "1/1", "--intensity", "none", "--out", str(part)]) in (None, 0) and part.is_file()
    )


def test_what_other_programs_put_where_nothing_returned_is_no_return(tmp_path: Path):
    image = street(3)
    empty = ~image.mask
    assert empty.any()
    stored(tmp_path / "nan.npz", range=np.where(empty, np.nan, image.range), mask=image.mask.astype(np.uint8))
    minus = {name: np.where(empty, -1, getattr(image, name)) for name in ("range", "reflectance")}
    stored(tmp_path / "minus.npz", **minus)
    for name in ("nan", "minus"):
        found = read_image(tmp_path / f"{name}.npz")
        assert found.mask.dtype == bool and (found.mask == image.mask).all()
        np.testing.assert_array_equal(found.range, image.range)
        np.testing.assert_array_equal(found.reflectance, image.reflectance)


@pytest.mark.parametrize(
    ("changed", "told"),
    [
        ({"range": np.where(street(3).mask, np.nan, 0)}, r"expected finite range of 0 to \d+, found \d+ such as nan"),
        ({"reflectance": street(3).reflectance * 255}, r"expected finite reflectance of 0 to 1, found \d+ such as"),
        ({"mask": street(3).mask * 2}, r"expected finite mask of 0 to 1, found \d+ such as 2"),
        ({"mask": street(3).mask.astype(float)}, "expected mask of truth values, found float64"),
        ({"range": street(3).range.astype(int)}, "expected range of floats, found int64"),
        ({"range": np.full((3, 3), np.nan)}, "expected finite range of .*, found 9 such as nan"),
    ],
)  # fmt: skip
def test_refusals_say_what_was_found_and_where(changed: dict[str, np.ndarray], told: str, tmp_path: Path):
    stored(tmp_path / "a.npz", **changed)
    with pytest.raises(ValueError, match=rf"a\.npz: {told}"):
        read_image(tmp_path / "a.npz")
    with np.load(tmp_path / "a.npz") as arrays:
        batch = {name: array if name == "sensor" else array[None].repeat(2, 0) for name, array in arrays.items()}
    (tmp_path / "batch").mkdir()
    np.savez(tmp_path / "batch/b.npz", **batch)
    with pytest.raises(ValueError, match=rf"b\.npz\[0\]: {told}"):
        ls.evaluate(tmp_path / "batch", [street(1)])


def test_beams_that_return_on_one_side_only_are_told_and_all_of_them_are_no_number():
    image = street(3)
    above = np.broadcast_to(np.arange(64)[:, None] < 32, image.shape)
    upper = image.keep(above)
    report = ls.evaluate([upper], [image], "bev-1")
    assert report.values["range, per beam"] == pytest.approx(0)
    assert any("of 64 beams return on one side only" in note for note in report.warnings)
    lower = image.keep(~above)
    assert ls.evaluate([upper], [lower], "bev-1").values["range, per beam"] is None
