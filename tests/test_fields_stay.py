"""What a file had is there after every verb: rings and times as they were, marks of points that were filled in."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import lidarsynth as ls
from lidarsynth.cli.outcomes import named_failure
from lidarsynth.files.arrays import IMAGE
from lidarsynth.files.fields import PLACE, FileError, written_names
from lidarsynth.files.formats import read, read_image, write
from lidarsynth.lidar.scan import Scan
from lidarsynth.lidar.unseen import caution, widest_gap
from lidarsynth.streets.reader import SyntheticStreets
from lidarsynth.verbs.batch import Result
from lidarsynth.verbs.inputs import Loaded, message_fields


@pytest.fixture(scope="module")
def street() -> Scan:
    """A VLP-16's scan, its rings from below and its times as a driver writes them."""
    scan = SyntheticStreets(5, 1, ls.get_sensor("vlp-16")).image(0).to_scan()
    stamps = np.uint64(1_600_000_000_000_000_000) + np.arange(len(scan), dtype=np.uint64) * 3000
    return replace(scan, label=None, extra={"Ring": np.uint16(15) - scan.ring.astype(np.uint16), "stamp": stamps})


def by_driver(street: Scan, path: Path) -> None:
    table = np.zeros(len(street), [(n, "<f4") for n in ("x", "y", "z", "intensity")] + [("ring", "<u2"), ("t", "<u8")])
    for i, axis in enumerate("xyz"):
        table[axis] = street.xyz[:, i]
    table["intensity"], table["ring"], table["t"] = street.reflectance, street.extra["Ring"], street.extra["stamp"]
    np.save(path, table)


def test_rings_and_times_come_back_as_the_file_has_them(street: Scan, tmp_path: Path):
    by_driver(street, tmp_path / "a.npy")
    scan = read(tmp_path / "a.npy")
    np.testing.assert_array_equal(scan.ring, street.ring)
    for suffix in (".pcd", ".ply", ".npz"):
        write(tmp_path / f"b{suffix}", scan)
        again = read(tmp_path / f"b{suffix}")
        np.testing.assert_array_equal(again.ring, street.ring)
        np.testing.assert_array_equal(again.extra["file_ring"], street.extra["Ring"])
        np.testing.assert_array_equal(again.extra["t"], street.extra["stamp"])
        write(tmp_path / f"c{suffix}", again)
        assert set(read(tmp_path / f"c{suffix}").extra) == set(again.extra), "nothing is added twice"


def test_a_denser_scan_keeps_the_rings_of_its_points(street: Scan):
    scan = replace(street, extra={})
    above = replace(scan, xyz=scan.xyz.copy())
    above.xyz[:5] = [0.1, 0, 20]  # above the view
    for one in (scan, above):
        up = ls.load("nearest").into("os1-64").upsample(one, "vlp-16").to_scan()
        old = up.extra["new"] == 0
        assert up.ring is not None and up.ring.min() >= 0 and up.ring.max() <= 63
        place = np.lexsort(up.xyz[old].T), np.lexsort(one.xyz.T)
        np.testing.assert_array_equal(up.extra["ring"][old][place[0]], one.ring[place[1]])


def test_points_that_were_filled_in_stay_so(street: Scan):
    model = ls.load("default")
    half = replace(street[street.xyz[:, 0] > 0], extra={})
    with pytest.warns(UserWarning, match="found hardly any in 1[78]. degrees of the turn"):
        once = model.complete(half).to_scan()
    with pytest.warns(UserWarning, match="that were filled in before"):
        whole = model.complete(once)
    twice, kept = whole.to_scan(), whole.surer_than(0.8).to_scan()
    assert (once.extra["new"] == 1).sum() > 100
    assert (twice.extra["new"] == 1).sum() >= (once.extra["new"] == 1).sum()
    doubted = (once.extra["new"] == 1) & (once.extra["confidence"] < 0.8)
    gone = {point.tobytes() for point in once.xyz[doubted]}
    assert gone and not gone & {point.tobytes() for point in kept.xyz}


@pytest.mark.parametrize("word", ["default", "nearest"])
def test_points_that_were_filled_in_stay_so_in_the_file_of_an_image(word: str, street: Scan, tmp_path: Path):
    """Also in one of before, which has no `new`."""
    image = ls.load(word).complete(replace(street[::3], extra={}))
    write(tmp_path / "a.npz", image)
    whole = read_image(tmp_path / "a.npz")
    said = {name: getattr(whole, name) for name in IMAGE if name != "new"}
    said = {name: part for name, part in said.items() if part is not None}
    np.savez(tmp_path / "b.npz", sensor=json.dumps(whole.sensor.to_dict()), **said)
    filled, sure = image.mask & ~image.xyz.any(axis=-1), image.confidence
    assert (ls.load(word).complete(whole).new >= filled).all()
    for path in (tmp_path / "a.npz", tmp_path / "b.npz"):
        once = read(path)
        np.testing.assert_array_equal(once.extra["new"], filled[image.mask])
        if sure is not None:
            np.testing.assert_array_equal(once.extra["confidence"], sure[image.mask])
        with pytest.warns(UserWarning, match=f"found {filled.sum()} of {len(once)} that were filled in before"):
            twice, up = ls.load(word).complete(once), ls.load(word).upsample(once, times=2)
        write(tmp_path / "c.npz", twice)
        for again in (twice.to_scan(), up.to_scan(), read(tmp_path / "c.npz")):
            marks = dict(zip(map(bytes, again.xyz), again.extra["new"], strict=True))
            assert all(marks[bytes(point)] == new for point, new in zip(once.xyz, once.extra["new"], strict=True))


def test_an_image_without_filled_pixels_has_no_marks(street: Scan, tmp_path: Path):
    write(tmp_path / "a.npz", ls.project(replace(street, extra={}), "vlp-16"))
    assert read_image(tmp_path / "a.npz").new is None and "new" not in read(tmp_path / "a.npz").extra


def test_names_that_files_can_hold():
    assert written_names(["länge", "", "a b", "a_b", "ring", "file_ring"], ["x", "ring"]) == \
        ["l_nge", "field", "a_b", "a_b_2", "file_ring", "file_ring_2"]  # fmt: skip


@pytest.mark.parametrize("suffix", [".pcd", ".ply", ".npz"])
def test_fields_of_any_name_are_written(suffix: str, tmp_path: Path):
    names = ["länge", "", "a b", "a_b", "x", "ring"]
    extra = {name: np.arange(3) + 10 * k for k, name in enumerate(names)}
    scan = Scan(np.float32([[9, 0, 0], [0, 9, 0], [9, 9, 0]]), np.float32([0, 0.5, 1]), np.arange(3), extra=extra)
    write(tmp_path / f"a{suffix}", scan)
    found = read(tmp_path / f"a{suffix}")
    np.testing.assert_array_equal(found.xyz, scan.xyz)
    np.testing.assert_array_equal(sorted(v[0] for v in found.extra.values()), sorted(v[0] for v in extra.values()))


def test_what_is_beside_a_bin_is_there_before_it(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    scan = Scan(np.ones((3, 3), np.float32), extra={"new": np.uint8([0, 1, 1])})
    import lidarsynth.files.formats as formats

    def killed(*_: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setitem(formats.WRITERS, ".bin", killed)
    with pytest.raises(KeyboardInterrupt):
        write(tmp_path / "a.bin", scan)
    assert (tmp_path / "a.new").is_file() and not (tmp_path / "a.bin").exists()


@pytest.mark.parametrize("suffix", [".bin", ".npy"])
def test_marks_of_a_file_that_is_gone_are_not_those_of_the_next(suffix: str, tmp_path: Path):
    plain = Scan(np.ones((3, 3), np.float32))
    extra = {"new": np.uint8([0, 1, 1]), "confidence": np.float32([1, 0.5, 0.25])}
    path, users = tmp_path / f"q{suffix}", tmp_path / "r.new"
    for again in (replace(plain, extra={"new": np.uint8([1, 0, 1])}), plain):
        write(path, replace(plain, extra=extra))
        path.unlink()
        write(path, again)
        assert read(path).extra.keys() == again.extra.keys()
    users.write_bytes(b"no marks of ours")
    write(users.with_suffix(suffix), plain)
    assert users.read_bytes() == b"no marks of ours", "what would not be taken for marks is no business of ours"


def test_centimetres_are_no_metres(tmp_path: Path):
    xyz = np.random.default_rng(0).normal(0, 2000, (500, 3)).astype(np.float32)
    np.save(tmp_path / "cm.npy", np.concatenate([xyz, np.zeros((500, 1), np.float32)], 1))
    with pytest.raises(FileError, match="are they centimetres"):
        read(tmp_path / "cm.npy")


def test_kilometres_are_no_metres(street: Scan, tmp_path: Path):
    write(tmp_path / "km.pcd", replace(street, xyz=street.xyz / 1000, extra={}))
    with pytest.raises(
        FileError, match=r"km\.pcd: expected metres .* almost all points 0\.0\d+ and less away: are they k"
    ):
        read(tmp_path / "km.pcd")
    with pytest.raises(ValueError, match="are they kilometres"):
        ls.load("nearest").into("vlp-16").complete(street.xyz / 1000)
    near = replace(street, xyz=street.xyz / 100, extra={})  # of a room of dolls
    write(tmp_path / "near.pcd", near)
    assert len(read(tmp_path / "near.pcd")) == len(near)


def test_new_points_of_a_message_have_the_ring_of_the_nearest_beam_and_its_scale():
    """Rows 0, 4 and 8 of a denser image are the message's rings 2, 1 and 0."""
    given = {"x": np.float32([9, 9, 9]), "y": np.zeros(3, np.float32), "z": np.float32([1, 0, -1]),
             "ring": np.uint8([2, 1, 0]), "intensity": np.uint16([7, 8, 9])}  # fmt: skip
    xyz = np.stack([given[axis] for axis in "xyz"], 1)
    extra = {PLACE: np.array([1, 2, 3, 0, 0, 0]), "new": np.array([0, 1, 0, 1, 1, 1], np.uint8)}
    light = np.float32([0, 0, 0, 0.25, 0.5, 1])
    filled = Scan(np.concatenate([xyz, xyz + 1]), light, ring=np.array([0, 4, 8, 1, 5, 7]), extra=extra)
    fields = message_fields(filled, Loaded(filled, given, 0, scale=65535))
    np.testing.assert_array_equal(fields["intensity"], [7, 8, 9, 16383, 32767, 65535])
    np.testing.assert_array_equal(fields["ring"], [2, 1, 0, 2, 1, 0])
    np.testing.assert_array_equal(fields["new"], filled.extra["new"])  # one had been filled in before
    np.testing.assert_array_equal(fields["x"][:3], given["x"])


@pytest.mark.parametrize(("turn", "wide"), [(np.arange(0, 360, 2), 1), (np.arange(-50, 51), 259), (np.array([7]), 359)])
def test_the_widest_gap_of_a_turn(turn: np.ndarray, wide: int):
    angle = np.radians(turn + 0.5)
    xyz = np.stack([9 * np.cos(angle), 9 * np.sin(angle), 0 * angle], 1).astype(np.float32)
    assert widest_gap(xyz) == wide
    many = np.concatenate([xyz * np.float32(scale) for scale in np.arange(1, 11)])
    assert (caution(Scan(many)) is None) == (wide < 45)


def test_hardly_any_points_are_told_to_be_a_guess():
    rng = np.random.default_rng(0)
    xyz = rng.normal(0, 10, (600, 3)).astype(np.float32)
    assert caution(Scan(xyz)) is None
    assert "found 40 points: most of what is put between is a guess" in str(caution(Scan(xyz[:40])))


def test_stray_points_do_not_fill_a_gap_and_old_ones_do_not_hide_it():
    rng = np.random.default_rng(0)
    angle = np.radians(np.concatenate([rng.uniform(0, 230, 9000), rng.uniform(230, 360, 8)]))
    scan = Scan(np.stack([9 * np.cos(angle), 9 * np.sin(angle), 0 * angle], 1).astype(np.float32))
    said = caution(scan)
    assert said is not None and "hardly any in 12" in said and "filled in before" not in said
    both = caution(replace(scan, extra={"new": np.ones(len(scan), np.uint8)}))
    assert both is not None and "filled in before" in both and "hardly any in 12" in both


def test_bad_arrays_are_told_by_the_library():
    model = ls.load("nearest").into("vlp-16")
    xyz = np.random.default_rng(0).normal(0, 10, (200, 3)).astype(np.float32)
    with pytest.raises(ValueError, match="reflectance of 0 to 1, found 0 to 255"):
        model.complete(Scan(xyz, np.linspace(0, 255, 200, dtype=np.float32)))
    xyz[3] = np.nan
    with pytest.raises(ValueError, match="finite points"):
        model.complete(Scan(xyz))
    with pytest.raises(ValueError, match="ring must be an array, got a list"):
        Scan(xyz, ring=[0] * 200)  # type: ignore[arg-type]
    with pytest.raises(ValueError, match=r"whole number of at least 2 times as many beams, found 2\.5"):
        ls.get_sensor("vlp-16").denser(2.5)  # type: ignore[arg-type]


@pytest.mark.filterwarnings("ignore:expected a turn of a sensor")
def test_what_python_lacks_is_asked_for_by_its_name_there():
    few, model = Scan(np.ones((50, 3), np.float32)), ls.load("default").into("vlp-16")
    with pytest.raises(ValueError, match=r"^expected at least 100 points.*: name it with --from, or sensor_in$"):
        model.upsample(few)
    with pytest.raises(ValueError, match=r"found both: for the former, .* name the scan's sensor as sensor_in$"):
        model.upsample(few, times=2)


def test_a_failure_names_its_file_and_which_message_of_it():
    def told(source: str, name: str, error: str) -> str:
        return named_failure(Result(name, Path(source), None, 0.0, error))

    assert told("a.bag", "a/000002", "expected points, found none") == "a.bag: 000002: expected points, found none"
    assert told("a.bag", "a/000002", "a.bag: a/000002: expected points") == "a.bag: a/000002: expected points"
    assert told("d/b.pcd.bin", "b", "expected points") == "d/b.pcd.bin: expected points"
    assert told("d/b.bin", "b", "d/b.bin: expected points") == "d/b.bin: expected points"


@pytest.mark.parametrize("suffix", [".bin", ".npy"])
def test_labels_of_bare_files_stand_beside_them(suffix: str, street: Scan, tmp_path: Path):
    """As the verbs write them: beside the file, or in labels/ beside velodyne/."""
    classes = np.arange(len(street)) % 20
    for folder, labels in (("a", "a"), ("velodyne", "labels")):
        (tmp_path / folder).mkdir()
        path = tmp_path / folder / f"x{suffix}"
        write(path, replace(street, label=classes))
        assert [p.suffix for p in (tmp_path / labels).iterdir() if p.suffix == ".label"] == [".label"]
        again = read(path, labels=tmp_path / labels / "x.label")
        np.testing.assert_array_equal(again.label, classes)


@pytest.mark.parametrize("kind", ["npy", "npz"])
def test_fields_of_several_numbers_of_a_structured_array_are_kept_as_of_a_pcd(kind: str, tmp_path: Path):
    """They were left out without a word."""
    points = [("x", "f4"), ("y", "f4"), ("z", "f4"), ("intensity", "f4")]
    table = np.zeros(6, [*points, ("normal", "f4", 3), ("cell", "u2", (1,)), ("none", "f4", (0,)), ("m", "f8", (2, 2))])
    for name in table.dtype.names or ():
        table[name] = np.arange(1, 1 + table[name].size).reshape(table[name].shape)
    table["intensity"] /= 10
    np.save(tmp_path / "a.npy", table)
    np.savez(tmp_path / "a.npz", points=table)
    scan = read(tmp_path / f"a.{kind}")
    assert sorted(scan.extra) == ["cell", "m_0", "m_1", "m_2", "m_3", *(f"normal_{i}" for i in range(3))]
    np.testing.assert_array_equal(np.stack([scan.extra[f"normal_{i}"] for i in range(3)], 1), table["normal"])
    np.testing.assert_array_equal(scan.extra["m_2"], table["m"][:, 1, 0])
    write(tmp_path / "b.ply", scan)
    np.testing.assert_array_equal(read(tmp_path / "b.ply").extra["normal_2"], table["normal"][:, 2])
