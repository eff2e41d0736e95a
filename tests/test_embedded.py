"""The library as a part of another program: what it is given, what it leaves as it was, and what it says at once."""

import copy
from collections.abc import Iterator
from contextlib import AbstractContextManager, contextmanager
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

import lidarsynth as ls
from lidarsynth.diffusion.samplers import generators
from lidarsynth.experiment.presets import preset
from lidarsynth.lidar.sensor import same_rays
from lidarsynth.networks.device import usual_torch
from lidarsynth.streets.reader import SyntheticStreets
from lidarsynth.systems.table import assemble, build_network

VLP = ls.get_sensor("vlp-16")


@pytest.fixture(scope="module")
def image() -> ls.RangeImage:
    return SyntheticStreets(5, 1, VLP).image(0)


@pytest.fixture(scope="module")
def scan(image: ls.RangeImage) -> ls.Scan:
    return replace(image.to_scan(), label=None)


@pytest.fixture(scope="module")
def model() -> ls.ScanModel:
    return ls.load("default")


def test_rings_that_count_from_the_bottom_are_refused(model: ls.ScanModel, scan: ls.Scan):
    assert scan.ring is not None
    below = replace(scan, ring=15 - scan.ring)
    fired = replace(scan, ring=np.argsort(np.arange(16) % 2 * 16 + np.arange(16))[::-1][scan.ring])
    for wrong, why in ((below, "from the bottom"), (fired, "another order")):
        for work in (model.complete, model.label, lambda s: ls.project(s, VLP)):
            with pytest.raises(ValueError, match=f"expected rings counted from the top, .* found .*{why}"):
                work(wrong)
    some = scan[np.random.default_rng(0).random(len(scan)) < 0.02]  # few points of each
    assert ls.project(some, VLP).mask.sum() > 50
    with pytest.raises(ValueError, match="expected rings counted from 0, found -1"):
        ls.project(replace(scan, ring=scan.ring - 1), VLP)


def test_an_image_is_completed_along_its_own_rays(model: ls.ScanModel, image: ls.RangeImage):
    known = ls.corrupt(image, "beams:4")
    for any_sensor in (model, ls.load("nearest")):
        done = any_sensor.complete(image, known)
        assert done.sensor.name == "vlp-16" and same_rays(done.sensor, image.sensor)
        measured = known & image.mask
        np.testing.assert_allclose(done.points()[measured], image.points()[measured], atol=1e-4)
    other = replace(image, sensor=replace(VLP, elevations=tuple(e - 5 for e in VLP.elevations)))
    for bound in (model.into("vlp-16"), ls.load("nearest").into("vlp-16")):
        with pytest.raises(
            ValueError, match="expected an image of vlp-16's beams, found one of vlp-16's; complete its"
        ):
            bound.complete(other, known)


def test_interpolations_take_a_scan_as_its_own_sensor_has_it(scan: ls.Scan):
    assert ls.load("bilinear").complete(scan).sensor.name == "vlp-16"
    assert ls.load("bilinear").into("os1-64").complete(scan).sensor.name == "os1-64"


def test_what_was_put_into_a_sensor_is_saved_so(model: ls.ScanModel, scan: ls.Scan, tmp_path: Path):
    for one in (model.into("os1-64"), ls.load("nearest").into("os1-64")):
        again = ls.load(one.save(tmp_path / one.experiment.name))
        assert again.complete(scan).sensor.name == one.complete(scan).sensor.name == "os1-64"


def test_seeds_are_whole_numbers_of_any_kind_and_size(model: ls.ScanModel, scan: ls.Scan):
    one, two = (model.complete(scan, method="sample", seed=seed) for seed in (3, np.int64(3)))
    np.testing.assert_array_equal(one.range, two.range)
    for wrong, found in ((1.5, "1.5"), (None, "None"), ("3", "'3'"), (-1, "-1")):
        with pytest.raises(ValueError, match=f"expected a seed .*found {found}"):
            model.complete(scan, seed=wrong)  # type: ignore[arg-type]
        with pytest.raises(ValueError, match=f"expected a seed .*found {found}"):
            model.generate(seed=wrong)  # type: ignore[arg-type]
    draws = [torch.rand(2, generator=generators(s, 1)[0]).tolist() for s in (0, 7, 1 << 32, 7 << 32, 1 << 70)]
    assert len({tuple(d) for d in draws}) == 5
    assert draws[1] == torch.rand(2, generator=torch.Generator().manual_seed(7)).tolist()


def test_what_cannot_be_generated_is_said_before_the_first_scan(model: ls.ScanModel):
    small = model.into("vlp-16")
    for wrong in ({"n": 0}, {"n": 2.5}, {"n": 1, "sampler": "foo"}, {"n": 1, "first": -1}, {"n": 1, "batch_size": 2.5},
                  {"n": 1, "steps": 2.5}, {"n": 1, "seed": "a"}):  # fmt: skip
        with pytest.raises(ValueError, match="expected"):
            small.stream(**wrong)  # type: ignore[arg-type]


def test_defaults_of_torch_do_not_matter_and_stay(model: ls.ScanModel, scan: ls.Scan):
    expected = model.complete(scan)
    torch.manual_seed(4)
    drawn = torch.rand(2).tolist()
    torch.manual_seed(4)
    torch.set_default_dtype(torch.float64)
    try:
        loaded = ls.load("default")
        assert {p.dtype for p in loaded.network.parameters()} == {torch.float32}
        found = [loaded.complete(scan), model.complete(scan)]
        next(ls.load("kitti-streets").stream(1, steps=1))
        assert torch.get_default_dtype() == torch.float64
        assert torch.rand(2, dtype=torch.float32).tolist() == drawn, (
            "loading and completing draw from nobody's generator"
        )
    finally:
        torch.set_default_dtype(torch.float32)
    for one in found:
        np.testing.assert_array_equal(one.range, expected.range)


@contextmanager
def float64() -> Iterator[None]:
    torch.set_default_dtype(torch.float64)
    try:
        yield
    finally:
        torch.set_default_dtype(torch.float32)


def around() -> dict[str, AbstractContextManager]:
    """What a program around the library may have set."""
    half = torch.autocast("cpu", torch.bfloat16)
    return {"half": half, "no learning": torch.inference_mode(), "meta": torch.device("meta"), "double": float64()}


@pytest.mark.parametrize("word", around())
def test_what_the_program_around_has_set_changes_no_scan(word: str):
    torch.manual_seed(0)
    made = [assemble(preset(name), build_network(preset(name))) for name in ("tiny", "tiny-gan")]
    known = np.arange(made[1].sensor.height)[:, None] % 2 + np.zeros(made[1].sensor.width) == 0

    def scans() -> list[np.ndarray]:
        gan = made[1].generate(1)[0]  # whose completion learns
        return [made[0].generate(1, steps=2)[0].range, gan.range, made[1].complete(gan, known, steps=2).range]

    expected = scans()
    with around()[word]:
        found = scans()
    for one, other in zip(found, expected, strict=True):
        np.testing.assert_array_equal(one, other)


def test_a_device_around_is_seen_where_torch_names_none(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(torch, "get_default_device", lambda: torch.device("cpu"))  # as torch 2.6 in a `with`
    with torch.device("meta"):
        with usual_torch():
            assert torch.zeros(1).device.type == "cpu"
        assert torch.zeros(1).device.type == "meta"


def test_the_default_type_stays_as_it_is_needed_until_the_last_thread_is_done():
    one, other = usual_torch(), usual_torch()  # of two threads
    with float64():
        one.__enter__()
        other.__enter__()
        one.__exit__(None, None, None)
        assert torch.get_default_dtype() == torch.float32, "the other is at work"
        other.__exit__(None, None, None)
        assert torch.get_default_dtype() == torch.float64


@pytest.mark.parametrize("word", around())
@pytest.mark.parametrize("protocol", ["street-2", "iln-2022"])
def test_what_the_program_around_has_set_changes_no_judgement_nor_its_own_images(word: str, protocol: str):
    images = [SyntheticStreets(seed, 1, ls.get_sensor("hdl-64e-kitti").resized(16, 1024)).image(0) for seed in (3, 4)]
    expected = ls.evaluate(images, images[::-1], protocol)
    seen = []

    class Made:
        def __len__(self) -> int:
            return 2

        def __getitem__(self, i: int) -> ls.RangeImage:
            seen.append(state())
            return images[i]

    def state() -> list[object]:
        own = torch.get_default_dtype(), torch.get_default_device().type
        return [*own, torch.is_autocast_enabled("cpu"), torch.is_inference_mode_enabled()]

    with around()[word]:
        found, own = ls.evaluate(Made(), images[::-1], protocol), state()
    assert found.values == expected.values and seen and all(told == own for told in seen)


def test_images_that_are_no_measurements_are_refused(model: ls.ScanModel, image: ls.RangeImage):
    far, light = image.range.copy(), image.reflectance * 255
    far[image.mask] = np.nan
    for wrong, why in ((far, "finite and above 0, found nan"), (-image.range, "finite and above 0, found -")):
        with pytest.raises(ValueError, match=why):
            replace(image, range=wrong)
    with pytest.raises(ValueError, match="expected a reflectance of 0 to 1"):
        model.complete(replace(image, reflectance=light))
    unknown = np.column_stack([np.ones((3, 3)), [0.5, np.nan, 1.0]])
    with pytest.raises(ValueError, match="0 to 1 in the fourth column, found NaN; put 0"):
        model.complete(unknown)
    with pytest.raises(ValueError, match="mask must be bool, got uint8"):
        replace(image, mask=image.mask.astype(np.uint8))
    with pytest.raises(ValueError, match="range must be an array, got a list"):
        replace(image, range=image.range.tolist())
    sure = replace(image, confidence=np.full(image.shape, 0.5, np.float32)).keep(np.zeros(image.shape, bool))
    assert sure.confidence is not None and not sure.confidence.any()


def test_sensors_of_lists_and_arrays_are_as_good_as_of_tuples(scan: ls.Scan, model: ls.ScanModel, tmp_path: Path):
    beams = np.linspace(10, -20, 20, dtype=np.float32)
    one = ls.Sensor("m", beams, np.int64(512), np.float32(1))  # type: ignore[arg-type]
    assert one == ls.Sensor("m", beams.tolist(), 512) and hash(one) == hash(copy.deepcopy(one))  # type: ignore[arg-type]
    ls.write(tmp_path / "a.npz", ls.project(scan, one))
    assert ls.read_image(tmp_path / "a.npz").sensor == one
    assert model.into(one).complete(scan).sensor == one
    for wrong in ({"elevations": None}, {"elevations": ["a"]}, {"width": 512.5}, {"width": "512"}, {"mount": np.nan},
                  {"offsets": (np.nan,) * 20}):  # fmt: skip
        with pytest.raises(ValueError, match="sensor m: "):
            replace(one, **wrong)


def test_scans_are_float32_whatever_they_were_made_of(scan: ls.Scan, model: ls.ScanModel):
    wide = ls.Scan(scan.xyz.astype(float), scan.reflectance.astype(float))
    assert wide.xyz.dtype == wide.reflectance.dtype == np.float32
    np.testing.assert_array_equal(model.complete(wide).range, model.complete(replace(scan, ring=None)).range)
    assert not ls.Scan(scan.xyz, None).reflectance.any()  # type: ignore[arg-type]
    for wrong, found in (([[1, 2, 3]], "a list"), (None, "a NoneType"), (torch.zeros(1, 3), "a Tensor"),
                         (np.array([["a"] * 3]), "one of <U1"), (np.ma.zeros((1, 3)), "a MaskedArray")):  # fmt: skip
        with pytest.raises(ValueError, match=f"xyz: expected an array of numbers, found {found}"):
            ls.Scan(wrong)  # type: ignore[arg-type]


def test_scans_compare_by_identity_and_are_no_sequences(scan: ls.Scan, image: ls.RangeImage):
    same = replace(scan)
    assert scan == scan and scan != same and scan in [same, scan] and len({scan, same, image}) == 3
    assert len(scan[[]]) == 0 and len(scan[[1, 2]]) == 2 and len(scan[:5]) == 5
    with pytest.raises(IndexError, match="expected a mask, indices or a slice of points, found 3"):
        scan[3]  # type: ignore[index]
    with pytest.raises(TypeError, match="not iterable"):
        list(scan)  # type: ignore[call-overload]


def test_marks_of_filled_scans_go_with_their_bin_files(model: ls.ScanModel, scan: ls.Scan, tmp_path: Path):
    done, path = model.complete(scan).to_scan(), tmp_path / "a.bin"
    ls.write(path, done)
    again = ls.read(path)
    np.testing.assert_array_equal(again.extra["new"], done.extra["new"])
    np.testing.assert_array_equal(again.extra["confidence"], done.extra["confidence"])
    with pytest.warns(UserWarning, match="filled in before"):
        more = model.complete(again).to_scan()
    assert more.extra["new"].sum() >= done.extra["new"].sum()
    ls.write(path, ls.Scan(done.xyz[::-1].copy()))
    assert not ls.read(path).extra and not list(tmp_path.glob("a.[nc]*"))
    (tmp_path / "a.new").write_bytes(b"mine")  # no marks of this file
    ls.write(path, ls.Scan(done.xyz))
    with pytest.warns(UserWarning, match=r"a.bin: a.new left out: expected \d+ bytes for \d+ points, found 4 bytes"):
        assert "new" not in ls.read(path).extra
    assert (tmp_path / "a.new").read_bytes() == b"mine"


def test_wrong_arguments_get_one_line(model: ls.ScanModel, scan: ls.Scan, image: ls.RangeImage, tmp_path: Path):
    named = replace(scan, extra={"name": np.full(len(scan), "a")})
    empty = scan[:0]
    calls = {
        "expected metres from the sensor, found half .* and more away": lambda: model.complete(1000 * scan.xyz),
        "expected points of .*, found the named fields f0, f1: Scan": lambda: model.complete(np.zeros(9, "f4, f4")),
        "expected a Scan, found a ndarray": lambda: ls.project(scan.xyz, "vlp-16"),  # type: ignore[arg-type]
        "expected a range image, .* found a Scan": lambda: ls.corrupt(scan, "beams:4"),  # type: ignore[arg-type]
        "known must be .* bool, got a str": lambda: model.complete(image, "beams:4"),  # type: ignore[arg-type]
        "expected a sensor or its word, found a NoneType": lambda: model.into(None),  # type: ignore[arg-type]
        "expected a sensor or its word, found a int": lambda: model.label(scan, 3),  # type: ignore[arg-type]
        "expected times that is a whole number, found 2.0": lambda: model.upsample(scan, times=2.0),  # type: ignore[arg-type]
        "expected a whole number of at least 2 times .*, found 0": lambda: model.upsample(scan, "vlp-16", times=0),
        "expected rings .first, last., found '0-31'": lambda: ls.read("x.pcd", rings="0-31"),  # type: ignore[arg-type]
        "expected a folder, files or .* found a RangeImage": lambda: ls.evaluate(image, [image]),  # type: ignore[arg-type]
        "expected a protocol of .*, found None": lambda: ls.evaluate([image], [image], protocol=None),  # type: ignore[arg-type]
        "expected fields of numbers in .ply, found name of <U1": lambda: ls.write(tmp_path / "a.ply", named),
        "expected a device of torch, .* found 'foo'": lambda: ls.load("default", device="foo"),
        "expected points within vlp-16's view, found none of 0": lambda: model.upsample(empty, "vlp-16"),
        "expected a least confidence of 0 to 1, found 'a'": lambda: model.label(scan, least="a"),  # type: ignore[arg-type]
        "expected a least confidence of 0 to 1, found None": lambda: image.surer_than(None),  # type: ignore[arg-type]
        "expected classes to take away of .*, found 5": lambda: model.complete(scan, without=5),  # type: ignore[arg-type]
        "sensor vlp-16: expected a whole number as width, found '64'": lambda: ls.project(scan, VLP, width="64"),  # type: ignore[arg-type]
        "sensor vlp-16: width must be at least 4 columns, got 0": lambda: ls.project(scan, VLP, width=0),
        "sensor vlp-16: height must divide its 16 beams, got 0": lambda: VLP.resized(height=0),
        "expected a sensor or its word, found a bytes": lambda: ls.load("kitti-streets").into(b"a"),  # type: ignore[arg-type]
        "expected weights by a word or a path, found a NoneType": lambda: ls.load(None),  # type: ignore[arg-type]
        "^: expected shipped weights .* found no file or folder": lambda: ls.load(""),
        "^aaa.*: expected shipped weights .* found no file or folder": lambda: ls.load(5000 * "a"),
        "expected a tensor of plain numbers, .* torch.sparse_coo": lambda: model.complete(torch.eye(4).to_sparse()),
        "expected a tensor of plain numbers, .* on meta": lambda: model.label(torch.zeros(4, 3, device="meta")),
    }
    for why, call in calls.items():
        with pytest.raises(ValueError, match=why):
            call()
    assert ls.get_sensor(VLP) is VLP


def test_models_take_arrays_and_tensors_of_points(model: ls.ScanModel, scan: ls.Scan):
    points = np.column_stack([scan.xyz, scan.reflectance])
    tensor = torch.from_numpy(points).double().requires_grad_()
    bound, bare = model.into(VLP), replace(scan, ring=None)
    for work in (bound.complete, model.label, lambda given: ls.load("nearest").upsample(given, "vlp-16")):
        expected = work(bare)
        expected = expected if isinstance(expected, ls.Scan) else expected.to_scan()
        for given in (points, tensor):
            found = work(given)
            found = found if isinstance(found, ls.Scan) else found.to_scan()
            np.testing.assert_array_equal(found.xyz, expected.xyz)
            np.testing.assert_array_equal(found.reflectance, expected.reflectance)
    with pytest.raises(ValueError, match=r"^expected points of .*, found \(9, 9\) of float32"):
        model.complete(torch.zeros(9, 9))


def test_what_load_gives_is_a_scan_model(model: ls.ScanModel):
    assert isinstance(model, ls.ScanModel) and isinstance(ls.load("nearest"), ls.ScanModel)


def test_points_out_of_the_view_of_the_sensor_that_is_named_are_told(model: ls.ScanModel, scan: ls.Scan):
    axes = np.ascontiguousarray(scan.xyz[:, [1, 2, 0]])  # y up
    fixed = model.into("vlp-16")
    works = [fixed.label, lambda points: model.label(points, "vlp-16"), lambda points: model.realise(points, "vlp-16")]
    for work in works:
        with pytest.warns(UserWarning, match="^expected points of vlp-16 in its frame .*, found .* outside its view"):
            work(axes)
        work(scan.xyz)
    fixed.label(SyntheticStreets(5, 1, ls.get_sensor("hdl-32e")).image(0).to_scan())  # another known sensor's
