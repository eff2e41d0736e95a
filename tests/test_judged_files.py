"""What of a user's files is judged, and what is refused or told: other units, copies, files beside scans."""

import json
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

import lidarsynth as ls
from lidarsynth.cli.main import main
from lidarsynth.evaluation import accumulation, statistics
from lidarsynth.evaluation.evaluate import gather_part
from lidarsynth.evaluation.image_sets import image_set
from lidarsynth.evaluation.protocols import BEV_1, LIDARGEN, STREET_1
from lidarsynth.evaluation.report import Report
from lidarsynth.files.formats import read_image, write
from lidarsynth.lidar.beams import same_beams
from lidarsynth.lidar.scan import RangeImage, Scan
from lidarsynth.lidar.sensor import SENSORS, Sensor, get_sensor

SENSOR = SENSORS["hdl-64e"].resized(width=64)


def street(seed: int, sensor: Sensor = SENSOR) -> RangeImage:
    rng = np.random.default_rng(seed)
    rays = sensor.directions()
    with np.errstate(divide="ignore"):
        distance = np.minimum(np.where(rays[..., 2] < 0, -1.7 / rays[..., 2], np.inf), 9 / np.abs(rays[..., 1]))
    mask = (distance < 60) & (rng.random(distance.shape) < 0.9)
    reflectance = (rng.random(mask.shape) * mask).astype(np.float32)
    return RangeImage(np.where(mask, distance, 0).astype(np.float32), reflectance, mask, sensor)


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


def test_samples_that_are_scans_of_the_reference_are_told(tmp_path: Path):
    """As of a reference below the folder of the samples, which is read at any depth."""
    samples = saved(tmp_path / "samples", range(3))
    real, other = saved(samples / "real", range(3, 5)), saved(tmp_path / "other", range(5, 8))
    batch(tmp_path / "batch.npz", range(8, 10))
    assert told(ls.evaluate(samples, real), "samples are scans of") == [
        "2 of 5 samples are scans of the reference, too: the sets look nearer than they are"
    ]
    assert told(ls.evaluate(real, samples), "2 of 2 samples are scans of the reference, too")
    (other / "linked.npz").symlink_to(tmp_path / "batch.npz")
    assert told(ls.evaluate(other, tmp_path / "batch.npz"), "2 of 5 samples are scans of the reference, too")
    assert not told(ls.evaluate(other, real), "samples are scans of")
    assert not told(ls.evaluate([street(0)], real), "samples are scans of")


@pytest.mark.parametrize("protocol", ["iln-2022", "street-upsampling-1", "lidm-reconstruction-2024"])
def test_pairs_of_the_same_images_in_another_order_are_told(protocol: str):
    real = [street(seed) for seed in range(3)]
    assert told(ls.evaluate(real, real, protocol), SAME) and not told(ls.evaluate(real, real, protocol), "order")
    report = ls.evaluate([real[1], real[0], real[2]], real, protocol)
    assert told(report, SAME) == [f"{SAME} in another order: 2 of 3 are compared with another image"]


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


SAME = "samples and reference are the same images"
KITTI = SENSORS["hdl-64e-kitti"].resized(width=64)


def told(report: Report, words: str) -> list[str]:
    return [note for note in report.warnings if words in note]


def test_an_empty_pixel_of_lidargens_code_is_no_return(tmp_path: Path):
    """Its program adds 0.1 mm before the logarithm, so that empty pixels are not 0; and judges from 0.5 m on."""
    image, folder = street(3), tmp_path / "published"
    folder.mkdir()
    code = np.log2(image.range + np.float32(1e-4) + 1) / 6
    assert code.min() > 2e-5
    raw = code + np.where(image.mask, 0, np.random.default_rng(0).uniform(-0.04, 0.04, code.shape)).astype(np.float32)
    for name, channel in (("0.pth", code), ("1.pth", raw)):
        torch.save(torch.from_numpy(np.stack([channel, image.reflectance])), folder / name)
    for i in (0, 1):
        found = image_set(folder).image(i, SENSOR, "spherical")
        np.testing.assert_array_equal(found.mask, image.mask)
        assert not found.range[~image.mask].any() and not found.reflectance[~image.mask].any()
    assert ls.evaluate(folder, [image, image], "iln-2022").values["range MAE"] == pytest.approx(0, abs=1e-3)
    near = torch.full((2, 64, 64), float(np.log2(1.6001) / 6))
    torch.save(near, folder / "1.pth")
    assert image_set(folder).image(1, get_sensor(LIDARGEN.sensor).resized(width=64), "spherical").mask.all(), "0.6 m"


@pytest.mark.parametrize("side", [0, 1])
def test_pairs_of_which_one_side_has_no_reflectance_have_no_error_of_it(side: int):
    lit, dark = street(3, SENSORS["hdl-64e-kitti"]), street(4, SENSORS["hdl-64e-kitti"])
    dark = replace(dark, reflectance=np.zeros_like(dark.reflectance))
    pair = [[dark], [lit]] if side == 0 else [[lit], [dark]]
    report = ls.evaluate(*pair, "street-upsampling-1")
    assert report.values["range MAE"] > 0 and report.classes is None
    for row in report.results[1:]:
        assert row.value is None and row.reason == f"the {('samples have', 'reference has')[side]} no reflectance"
    some = ls.evaluate([lit, *pair[0]], [lit, *pair[1]], "street-upsampling-1")
    assert some.values["reflectance MAE"] is not None
    name = ("samples", "reference")[side]
    assert told(some, "no reflectance") == [f"1 of 2 images of the {name} have no reflectance, which counts as 0"]
    assert not told(ls.evaluate([lit], [lit], "street-upsampling-1"), "no reflectance")


@pytest.mark.parametrize("side", [0, 1])
def test_a_set_of_which_some_images_have_no_reflectance_is_told(side: int):
    lit = [street(seed, SENSORS["hdl-64e-kitti"]) for seed in range(2)]
    mixed = [lit[0], replace(lit[1], reflectance=np.zeros_like(lit[1].reflectance))]
    report = ls.evaluate(*((mixed, lit) if side == 0 else (lit, mixed)), "street-1")
    assert report.values["FRD"] is not None
    name = ("samples", "reference")[side]
    assert told(report, "no reflectance") == [f"1 of 2 images of the {name} have no reflectance, which counts as 0"]
    assert not told(ls.evaluate(lit, lit, "street-1"), "no reflectance")
    assert not told(ls.evaluate(mixed, lit), "no reflectance"), "which bev-1 does not look at"


@pytest.mark.parametrize("order", [(0, 1, 2), (2, 0, 1), (0, 2, 1)])
@pytest.mark.parametrize("side", [0, 1])
def test_images_of_several_sensors_in_one_set_are_told_and_have_no_rows_per_beam(order, side: int, tmp_path: Path):
    images = [street(0), street(1), street(2, KITTI)]
    mixed, real = [images[i] for i in order], [street(seed) for seed in range(10, 13)]
    report = ls.evaluate(*((mixed, real) if side == 0 else (real, mixed)))
    name = ("samples", "reference")[side]
    (note,) = told(report, "other beams than")
    of = "1 of 3" if order[0] != 2 else "2 of 3"
    first = ("hdl-64e", "hdl-64e-kitti")[order[0] == 2]
    assert note == f"{of} images of the {name} are of other beams than those of {first}, which all are judged as"
    assert report.values["no return, per beam"] is None and report.values["range, per beam"] is None
    assert report.beams is None and report.values["JSD x1e2"] is not None
    assert not told(ls.evaluate(real, real), "other beams")


def test_points_of_a_sensor_that_nobody_knows_are_told_where_the_images_do_not_see_them(tmp_path: Path):
    """As of one of a user's own, whose points the protocol's images would squeeze into their first and last rows."""
    own = Sensor("own", tuple(np.linspace(12, -22, 24) + 0.3 * np.sin(np.arange(24))), width=900)
    for folder, seeds in (("samples", range(2)), ("real", range(2, 4))):
        (tmp_path / folder).mkdir()
        for seed in seeds:
            write(tmp_path / folder / f"{seed}.pcd", street(seed, own))
    sides = tmp_path / "samples", tmp_path / "real"
    notes = told(ls.evaluate(*sides), "that hdl-64e sees, whose images they are drawn into")
    assert len(notes) == 2 and "points of samples" in notes[0] and "points of the reference" in notes[1]
    assert "of them outside its view of -24.6 to +3.0 degrees: other beams" in notes[0]
    assert not told(ls.evaluate(*sides, sensor=own), "other beams")
    images = [street(seed, own) for seed in range(2)]
    assert not told(ls.evaluate(images, images), "other beams (of points"), "which keep their own rows"
    inside = [street(seed, SENSORS["hdl-64e-kitti"].resized(width=64)).to_scan() for seed in range(2)]
    assert not told(ls.evaluate(inside, inside), "drawn into, found")
    outside = [street(seed, own).to_scan() for seed in range(2)]
    assert told(ls.evaluate(outside, outside), "drawn into, found")
    assert not told(ls.evaluate(outside + inside, inside), "drawn into, found"), "where no more than half are of others"
    camera = [Scan(scan.xyz[:, [1, 2, 0]] * np.float32([-1, -1, 1]), scan.reflectance) for scan in outside]
    assert not told(ls.evaluate(camera, camera), "drawn into, found"), "whose frame is what is told of"


def test_points_of_a_known_sensor_are_told_where_those_of_ones_own_do_not_see_them():
    scans = [street(seed, SENSORS["hdl-32e"]).to_scan() for seed in range(2)]
    narrow, alike = Sensor("narrow", tuple(np.linspace(2, -8, 16))), replace(SENSORS["hdl-32e"], name="alike")
    assert len(told(ls.evaluate(scans, scans, sensor=narrow), "narrow sees, whose images they are drawn into")) == 2
    assert not told(ls.evaluate(scans, scans, sensor=alike), "drawn into")


def test_several_sensors_are_told_of_merged_parts_too(tmp_path: Path):
    (tmp_path / "mixed").mkdir()
    for i, image in enumerate((street(0), street(1), street(2), street(2, KITTI))):
        write(tmp_path / f"mixed/{i}.npz", image)
    parts = [tmp_path / f"{i}.safetensors" for i in (1, 2)]
    for i, part in enumerate(parts, 1):
        gather_part(tmp_path / "mixed", f"{i}/2", part)
    report = ls.evaluate(parts, [street(seed) for seed in range(10, 14)])
    assert told(report, "1 of 4 images of the samples are of other beams") and report.beams is None


def test_pairs_of_other_beams_are_told():
    for samples, told_of in (([street(0, KITTI)] * 2, 2), ([street(0), street(0, KITTI)], 1)):
        for protocol in ("r2dm-upsampling-2024", "iln-2022"):
            (note,) = told(ls.evaluate(samples, [street(0), street(1)], protocol), "other beams")
            of = "hdl-64e-kitti against hdl-64e"
            assert note == f"{told_of} of 2 samples are of other beams than their reference, first {of}"
    assert not told(ls.evaluate([street(0)], [street(1)], "iln-2022"), "other beams")


@pytest.mark.parametrize("protocol", ["r2dm-upsampling-2024", "iln-2022"])
def test_points_of_a_pair_are_drawn_by_their_rings_as_other_verbs_draw_them(protocol: str):
    image = street(0, replace(SENSORS["hdl-32e"], width=64))
    row = np.broadcast_to(np.arange(32)[:, None], image.shape)[image.mask]
    far, turn = image.range[image.mask], image.sensor.ray_angles()[1][image.mask]
    low = np.radians(np.array(image.sensor.elevations) - 0.8)[row]  # nearer to the next beam, as calibrations have it
    directions = np.stack([np.cos(low) * np.cos(turn), np.cos(low) * np.sin(turn), np.sin(low)], axis=1)
    scan = Scan((far[:, None] * directions).astype(np.float32), image.reflectance[image.mask], ring=row.astype(int))
    drawn = ls.project(scan, image.sensor)
    assert np.array_equal(drawn.mask, image.mask) and not np.array_equal(
        ls.project(scan, image.sensor, "spherical").mask, image.mask
    )
    for samples, reference in (([drawn], [scan]), ([scan], [drawn])):
        assert ls.evaluate(samples, reference, protocol).values["range MAE"] == 0


def test_beams_that_differ_by_rounding_are_the_same(tmp_path: Path):
    """A generator of float32 has them, and a file of a sensor says them in six digits."""
    off = 1e-6 * np.random.default_rng(0).uniform(-1, 1, SENSOR.height)
    rounded = replace(SENSOR, elevations=tuple((np.array(SENSOR.elevations) + off).tolist()))
    samples, real = [street(seed) for seed in range(3)], [street(seed) for seed in range(10, 13)]
    expected = ls.evaluate(samples, real)
    for given, sensor in (([replace(i, sensor=rounded) for i in samples], None), (samples, rounded)):
        report = ls.evaluate(given, real, sensor=sensor)
        assert not told(report, "other beams") and not told(report, "is not used")
        assert report.beams is not None and report.values == pytest.approx(expected.values, rel=1e-3)
    mixed = ls.evaluate([samples[0], replace(samples[1], sensor=rounded)], real)
    assert not told(mixed, "other beams") and mixed.values["range, per beam"] is not None
    pairs = ls.evaluate([replace(samples[0], sensor=rounded)], real[:1], "iln-2022")
    assert not told(pairs, "other beams")
    other = replace(SENSOR, elevations=tuple((np.array(SENSOR.elevations) + 1e-3).tolist()))
    assert not same_beams(SENSOR, other) and not same_beams(SENSOR, SENSOR.resized(32))


def test_rays_without_return_are_counted_however_far_a_sensor_sees():
    """Only the row of ranges needs the same bins."""
    samples, real = [street(seed) for seed in range(3)], [street(seed) for seed in range(10, 13)]
    nearer = replace(SENSOR, max_range=60.0)
    expected = ls.evaluate(samples, real).values
    report = ls.evaluate([replace(image, sensor=nearer) for image in samples], real)
    assert report.values["no return, per beam"] == expected["no return, per beam"] and report.beams is None
    (row,) = (result for result in report.results if result.name == "range, per beam")
    assert row.value is None and "120 bins of 0.5 m" in row.reason


def test_images_of_other_points_or_sensors_are_not_the_same():
    """Their ranges alone are."""
    image = street(3)
    ahead = image.points()
    turned = replace(image, xyz=np.stack([-ahead[..., 1], ahead[..., 0], ahead[..., 2]], -1))
    other = replace(image, sensor=KITTI)
    for samples in (turned, other):
        report = ls.evaluate([samples], [image])
        assert report.values["JSD x1e2"] > 1 and not told(report, SAME)
        assert report.hashes["samples"] != report.hashes["reference"]
    assert told(ls.evaluate([replace(image, xyz=ahead)], [image]), SAME), "the points of its rays are no other ones"


@pytest.mark.parametrize("protocol", ["lidm-2024", "lidm-reconstruction-2024"])
def test_the_same_images_are_not_at_zero_where_one_side_is_drawn_again(protocol: str, tmp_path: Path, monkeypatch):
    monkeypatch.setattr(accumulation, "URLS", dict.fromkeys(accumulation.URLS, (tmp_path / "nowhere").as_uri()))
    real = saved(tmp_path / "real", range(2))
    copy = Path(shutil.copytree(real, tmp_path / "copy"))
    images = [street(seed) for seed in range(2)]
    reports = [ls.evaluate(*sides, protocol) for sides in ((real, real), (copy, real), (images, images))]
    for report in reports:
        (note,) = told(report, SAME)
        assert note.endswith("takes the reference otherwise than samples: distances are what that costs, or 0")
        assert report.values == reports[0].values and next(v for v in report.values.values() if v is not None) > 0
    assert not told(ls.evaluate(images, [street(seed) for seed in (8, 9)], protocol), SAME)
    (plain,) = told(ls.evaluate(images, images), SAME)
    assert plain.endswith("distances are 0, or as far as chance goes")


def test_points_of_an_image_that_are_not_as_far_as_its_range_are_refused(tmp_path: Path):
    image, folder = street(3), tmp_path / "images"
    folder.mkdir()
    real = [street(5)]
    for form, xyz in (("twice", 2 * image.points()), ("shifted", image.points() + np.float32([0, 0, 1.73]))):
        stored(folder / "a.npz", xyz=xyz)
        with pytest.raises(
            ValueError, match=r"a\.npz: expected a range of \|x, y, z\| in metres, found another in"
        ) as no:
            ls.evaluate(folder, real)
        assert "\n" not in str(no.value), form
    some = image.points() * (np.arange(64)[:, None] % 4 == 0)
    stored(folder / "a.npz", xyz=some)
    assert ls.evaluate(folder, real).counts["samples"] == 1, "filled pixels have no points of their own"


@pytest.mark.parametrize("name", ["hdl-64e", "hdl-64e-kitti", "os1-64", "pandar64", "vlp-16"])
def test_images_of_recorded_points_are_judged(name: str):
    """Beams leave some centimetres off the origin; a range is that of the point all the same."""
    sensor = get_sensor(name)
    image = street(3, sensor)
    moved = image.points()[image.mask] + np.float32([0.02, -0.01, 0.15])
    drawn = ls.project(Scan(moved, image.reflectance[image.mask]), sensor, "spherical")
    assert drawn.xyz is not None
    assert ls.evaluate([drawn], [drawn]).counts["samples"] == 1


def test_iln_counts_the_points_within_the_sensors_limits():
    """1.45 and 80 m of an hdl-64e, both included, of the truth as of the result; its MAE is of all pixels."""
    truth = street(3)
    empty, limits = ~truth.mask, (truth.sensor.min_range, truth.sensor.max_range)
    spots = np.flatnonzero(empty)[:4]
    for outside in ((1.0, 1.44), (80.5, 99.0)):
        distance, mask = truth.range.copy(), truth.mask.copy()
        distance.flat[spots], mask.flat[spots] = np.resize(outside, 4), True
        other = replace(truth, range=distance, mask=mask)
        for pair in ((other, truth), (truth, other)):
            values = ls.evaluate([pair[0]], [pair[1]], "iln-2022").values
            assert [values[f"voxel {row}"] for row in ("IoU", "precision", "recall", "F1")] == [100] * 4
            assert values["range MAE"] > 0
    distance.flat[spots[:2]] = limits
    edge = replace(truth, range=distance, mask=mask)
    assert ls.evaluate([edge], [truth], "iln-2022").values["voxel precision"] < 100


def test_tensors_are_looked_at_wherever_they_come(tmp_path: Path):
    protocol = replace(STREET_1, networks=(), rows=BEV_1.rows)
    real, mixed = saved(tmp_path / "real", range(2)), saved(tmp_path / "mixed", range(2))
    image = street(3, KITTI)
    whole = np.stack([image.range, *np.moveaxis(image.points(), -1, 0), image.reflectance])
    torch.save(torch.from_numpy(whole), mixed / "7.pth")
    torch.save(torch.from_numpy(np.stack([np.log2(image.range + 1) / 6, image.reflectance])), mixed / "8.pth")
    for sides in ((mixed, real), (real, mixed)):
        notes = told(ls.evaluate(*sides, protocol), "tensors")
        assert len(notes) == 2 and "degrees off the beams of hdl-64e" in notes[0] and "without points" in notes[1]


@pytest.mark.parametrize("protocol", ["bev-1", "iln-2022", "lidm-reconstruction-2024"])
@pytest.mark.parametrize("shape", [(3, 64, 64), (5, 63, 64), (64, 64)])
def test_a_tensor_of_another_shape_is_named(shape: tuple[int, ...], protocol: str, tmp_path: Path):
    real, folder = saved(tmp_path / "real", range(1)), tmp_path / "other"
    folder.mkdir()
    torch.save(torch.zeros(shape), folder / "0.pth")
    for sides in ((folder, real), (real, folder)):
        with pytest.raises(ValueError, match=r"other/0\.pth: expected .*found"):
            ls.evaluate(*sides, protocol)


def test_statistics_that_another_version_gathered_are_told(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """Their definition says what is computed of images, and not how scans become these."""
    images, files = [street(i) for i in range(4)], [tmp_path / f"{name}.safetensors" for name in ("then", "now")]
    for file, rules in zip(files, (statistics.GATHERED - 1, statistics.GATHERED), strict=True):
        with monkeypatch.context() as patched:
            patched.setattr(statistics, "GATHERED", rules)
            gather_part(images, "1/1", file, side="reference")
    told = [[note for note in ls.evaluate(images, file).warnings if "another" in note] for file in files]
    assert [len(notes) for notes in told] == [1, 0] and told[0][0].startswith(f"{files[0]}: expected statistics")
    with pytest.raises(ValueError, match="gathered as by this version"):  # or their numbers would pass for this one's
        gather_part(files[0], "1/1", tmp_path / "again.safetensors")


def test_files_of_statistics_keep_the_notes_on_their_images(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    """Or what is said of a folder would not be said of the same folder whose parts two machines gathered."""
    shares = [replace(image, range=image.range / 80) for image in map(street, range(4))]
    other = "lidm-2024"  # which wants sequences that a list does not have
    straight = ls.evaluate(shares, [street(4), street(5)]).warnings
    *parts, merged, reference = (tmp_path / f"{name}.safetensors" for name in ("1", "2", "both", "real"))
    for i, part in enumerate(parts, 1):
        gather_part(shares, f"{i}/2", part)
    gather_part(parts, "1/1", merged)
    gather_part([street(4), street(5)], "1/1", reference, side="reference")
    for files in (parts, merged):
        for truth in (reference, [street(4), street(5)]):
            report = ls.evaluate(files, truth)
            assert set(report.warnings) == set(straight) and len(told(report, "not shares of a limit")) == 1
    gather_part([street(4)], "1/1", reference, other, side="reference")
    assert told(ls.evaluate([street(5)], reference, other), "compares with the sequences")
    write(tmp_path / "share.npz", shares[0])
    main(["evaluate", str(tmp_path / "share.npz"), "--part", "1/1", "--out", str(merged)])
    assert "note: ranges of samples are" in capsys.readouterr().out


@pytest.mark.parametrize("notes", ['{"a": 1}', "[1]", "none"])
def test_notes_that_are_none_are_refused(notes: str, tmp_path: Path):
    file, kept = tmp_path / "s.safetensors", statistics.Statistics(BEV_1, SENSOR, "samples")
    statistics.save_statistics(file, kept, {"notes": notes})
    with pytest.raises(ValueError, match=r"s\.safetensors: expected notes as a list of texts, found another thing"):
        ls.evaluate(file, [street(0)])
    statistics.save_statistics(file, kept, {"notes": json.dumps(["one\nline \x1b[2J"])})
    assert told(ls.evaluate(file, [street(0)]), "one line  [2J")
