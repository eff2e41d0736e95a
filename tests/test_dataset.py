"""Caches: exact to their steps, resumable after a kill, honest about broken scans, full disks and damaged shards."""

import json
import os
import resource
import shutil
import signal
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from forked import Forked
from oracle import assert_close
from random_images import SENSOR, WHAT, image, name
from test_frame import moved, street
from torch.utils.data import DataLoader

from lidarsynth.cli.main import main
from lidarsynth.data import cache
from lidarsynth.data.dataset import CachedImages, SeveralCaches, read_index, verify, write_cache
from lidarsynth.data.sources import SOURCES, Projected, cache_source, cache_synthetic, prepare, summary, unfit
from lidarsynth.files.formats import write
from lidarsynth.lidar.depth import CODECS, to_x_0
from lidarsynth.lidar.frame import parse_transform
from lidarsynth.lidar.projection import project, thin
from lidarsynth.lidar.scan import RangeImage, Scan
from lidarsynth.lidar.sensor import SENSORS, Sensor


def fails_at(*bad: int):
    def make(i: int) -> RangeImage:
        if i in bad:
            raise ValueError(f"scan {i}: expected points, found none")
        return image(i)

    return make


def state(folder: Path) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in sorted(folder.iterdir())}


def scans(root: Path, count: int) -> None:
    """`count` KITTI files of 300 points each on the beams of the HDL-64E, as sequence 00 of the odometry benchmark."""
    folder = root / "sequences" / "00" / "velodyne"
    folder.mkdir(parents=True)
    for i in range(count):
        rng = np.random.default_rng(i)
        azimuth, elevation = rng.uniform(-np.pi, np.pi, 300), np.radians(rng.uniform(-24, 1, 300))
        ray = np.stack([np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), np.sin(elevation)], 1)
        table = np.column_stack([ray * rng.uniform(2, 70, (300, 1)), rng.random(300)])
        table.astype("<f4").tofile(folder / f"{i:06d}.bin")


def test_images_come_back_to_a_millimetre(tmp_path: Path):
    assert list(write_cache(tmp_path, image, 150, SENSOR, WHAT, name)) == [64, 128, 150]
    images = CachedImages(tmp_path)
    assert (len(images), images.sensor, images.source) == (150, SENSOR, WHAT)
    for i in (0, 1, 63, 64, 149):
        got, expected = images[i], image(i)
        np.testing.assert_array_equal(got.mask, expected.mask)
        np.testing.assert_allclose(got.range, expected.range, atol=0.00101)
        np.testing.assert_allclose(got.reflectance, expected.reflectance, atol=0.5 / 255 + 1e-6)
        assert images.name(i) == name(i)
        assert (got.label is None) == (expected.label is None)
        if got.label is not None:
            np.testing.assert_array_equal(got.label, expected.label)
    with pytest.raises(IndexError, match=r"0\.\.149, got 150"):
        images.record(150)


@pytest.mark.parametrize("codec", CODECS)
def test_x_0_is_that_of_the_images(tmp_path: Path, codec: str):
    list(write_cache(tmp_path, image, 70, SENSOR, WHAT))
    images = CachedImages(tmp_path)
    x_0 = images.x_0([69, 0, 7], codec)
    assert x_0.dtype == torch.float32 and x_0.is_contiguous()
    expected = torch.stack([to_x_0(images[i], codec) for i in (69, 0, 7)])
    torch.testing.assert_close(x_0, expected, rtol=0, atol=2e-7)
    assert ((x_0[:, 0] == -1) == (expected[:, 0] == -1)).all()


def test_every_range_of_a_metre_has_its_own_code(tmp_path: Path):
    """All 65,536 stored ranges through the table of logarithms and through the codec itself."""
    wide = Sensor("wide", SENSOR.elevations, 8192, 1.45, 80.0)
    distance = (np.arange(65536, dtype=np.float32) * np.float32(0.002)).reshape(8, 8192)
    whole = RangeImage(distance, np.zeros_like(distance), distance > 0, wide)
    list(write_cache(tmp_path, lambda i: whole, 1, wide, WHAT))
    torch.testing.assert_close(CachedImages(tmp_path).x_0([0])[0], to_x_0(whole), rtol=0, atol=2e-7)


def test_a_loader_reads_it_in_its_own_processes(tmp_path: Path):
    list(write_cache(tmp_path, image, 70, SENSOR, WHAT))
    images = CachedImages(tmp_path)
    loader = DataLoader(range(70), batch_size=16, collate_fn=images.x_0, num_workers=1, multiprocessing_context="spawn")
    torch.testing.assert_close(torch.cat(list(loader)), images.x_0(list(range(70))), rtol=0, atol=0)


def test_open_files_and_memory_do_not_grow_with_the_cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(cache, "SHARD", 1)
    list(write_cache(tmp_path, image, 300, SENSOR, WHAT))
    images = CachedImages(tmp_path)
    before = len(os.listdir("/proc/self/fd"))
    batches = [images.x_0(list(range(300))) for _ in range(2)]
    assert len(os.listdir("/proc/self/fd")) == before
    torch.testing.assert_close(*batches, rtol=0, atol=0)
    assert "0000299.npy" not in Path("/proc/self/maps").read_text()


def test_several_caches_are_one_of_which_each_is_seen_equally_often(tmp_path: Path):
    folders = [tmp_path / "five", tmp_path / "two"]
    list(write_cache(folders[0], image, 5, SENSOR, {"name": "five", "projection": "auto"}, name=name))
    list(write_cache(folders[1], lambda i: image(10 + i), 2, SENSOR, {"name": "two", "projection": "auto"}))
    one, five, two = SeveralCaches(folders), CachedImages(folders[0]), CachedImages(folders[1])
    expected = [five[0], two[0], five[1], two[1], five[2], two[0], five[3], two[1], five[4], two[0]]
    assert len(one) == 10 and one.sensor == SENSOR
    for found, truth in zip(one.take([*range(10)]), expected, strict=True):
        np.testing.assert_array_equal(found.range, truth.range)
    torch.testing.assert_close(one.x_0([1, 2, 3]), torch.cat([two.x_0([0]), five.x_0([1]), two.x_0([1])]))
    assert (one.name(2), one.name(7)) == (five.name(1), two.name(1))
    assert one.source == {"name": "several caches (5 of five and 2 of two)", "projection": "auto"}
    assert one.spread(20) == [*range(10)] and five.spread(20) == [*range(5)] and five.spread(2) == [0, 2]
    assert one.spread(5) == [0, 3, 4, 7, 8], "every second number would be of the first cache alone"
    for wrong in (-1, 10):
        with pytest.raises(IndexError, match=rf"0\.\.9, got {wrong}"):
            one[wrong]
    list(write_cache(tmp_path / "streets", image, 2, SENSOR, {"name": "synthetic", "seed": 1}))
    for order in ([folders[0], tmp_path / "streets"], [tmp_path / "streets", folders[0]]):
        assert SeveralCaches(order).source["projection"] == "auto" and len(SeveralCaches(order)) == 10
    far = replace(SENSOR, max_range=70.0)
    list(write_cache(tmp_path / "far", lambda i: replace(image(i), sensor=far), 1, far, {"name": "synthetic"}))
    with pytest.raises(ValueError, match=r"8 x 32 and any projection, found eight of 8 x 32 and any projection$"):
        SeveralCaches([tmp_path / "streets", tmp_path / "far"])
    for other, source in ((replace(SENSOR, max_range=70.0), "auto"), (SENSOR, "unfolding")):
        write = write_cache(tmp_path / "o", lambda i, s=other: replace(image(i), sensor=s), 1, other,
                            {"name": "o", "projection": source})  # fmt: skip
        list(write)
        with pytest.raises(ValueError, match=r"o: expected the sensor and the projection of .*five, eight of 8 x 32"):
            SeveralCaches([folders[0], tmp_path / "o"])
        shutil.rmtree(tmp_path / "o")


def test_a_cache_of_the_first_format_is_read_and_continued(tmp_path: Path):
    """Made before images had names: shards with a count and a checksum only, label 0 where there were none."""
    list(write_cache(tmp_path, image, 100, SENSOR, WHAT))
    index = read_index(tmp_path)
    index["shards"] = {n: {k: e[k] for k in ("count", "sha256")} for n, e in index["shards"].items()}
    (tmp_path / "index.json").write_text(json.dumps(index, indent=1))
    assert CachedImages(tmp_path).name(99) == ("test", "", "99")
    assert verify(tmp_path) == 100
    assert list(write_cache(tmp_path, image, 200, SENSOR, WHAT)) == [64, 128, 192, 200]
    images = CachedImages(tmp_path)
    assert len(images) == 200
    np.testing.assert_array_equal(images[120].mask, image(120).mask)


def test_workers_write_what_one_process_writes(tmp_path: Path):
    for folder, workers in (("one", 0), ("two", 2)):
        done = list(write_cache(tmp_path / folder, image, 130, SENSOR, WHAT, name, workers))
        assert done == [64, 128, 130]
    assert state(tmp_path / "one") == state(tmp_path / "two")


def test_an_interrupted_call_goes_on_where_it_was(tmp_path: Path):
    list(write_cache(tmp_path / "whole", image, 300, SENSOR, WHAT, name))
    first = write_cache(tmp_path / "part", image, 300, SENSOR, WHAT, name)
    assert [next(first), next(first)] == [64, 128]
    first.close()
    asked = []

    def watched(i: int) -> RangeImage:
        asked.append(i)
        return image(i)

    assert list(write_cache(tmp_path / "part", watched, 300, SENSOR, WHAT, name)) == [128, 192, 256, 300]
    assert asked == list(range(128, 300))
    assert state(tmp_path / "whole") == state(tmp_path / "part")
    assert list(write_cache(tmp_path / "part", fails_at(*range(300)), 300, SENSOR, WHAT, name)) == [300]


def test_killed_at_any_moment_the_same_command_goes_on(tmp_path: Path):
    scans(tmp_path, 200)
    options = ("--projection", "spherical", "--width", 1024, "--workers", 2)
    words = ("data", "kitti", tmp_path, tmp_path / "cache", *options)
    kills = 0
    for shards in (1, 2):
        process = Forked(*words)
        while process.poll() is None and len(list((tmp_path / "cache").glob("*.npy"))) < shards:
            time.sleep(0.005)
        process.send_signal(signal.SIGKILL)
        kills += process.wait() == -signal.SIGKILL
    assert kills >= 1
    done = Forked(*words)
    said, errors = done.communicate()
    assert done.returncode == 0, errors[-2000:]
    assert "wrote 200 images of 1 sequence in" in said
    list(cache_source("kitti", tmp_path, tmp_path / "whole", projection="spherical", width=1024))
    assert state(tmp_path / "cache") == state(tmp_path / "whole"), "no leftovers of the killed processes either"


def test_broken_scans_are_skipped_named_and_counted(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    scans(tmp_path, 70)
    velodyne = tmp_path / "sequences" / "00" / "velodyne"
    (velodyne / "000003.bin").write_bytes(b"broken")
    (velodyne / "000066.bin").write_bytes(b"")
    folder = tmp_path / "cache"
    main(["data", "kitti", str(tmp_path), str(folder), "--projection", "spherical"])
    assert "wrote 68 images of 1 sequence" in (said := capsys.readouterr().out)
    assert f"2 broken scans skipped (named in {folder}/report.json)" in said
    told = json.loads((folder / "report.json").read_text())
    assert told["stored"] == 68 and told["sequences"] == {"00": 68}
    assert [(s["sequence"], s["frame"]) for s in told["skipped"]] == [("00", "000003"), ("00", "000066")]
    assert "000003.bin: expected whole points" in told["skipped"][0]["reason"]
    images = CachedImages(folder)
    assert [images.name(i).frame for i in (2, 3, 62, 65, 67)] == ["000002", "000004", "000063", "000067", "000069"]
    assert verify(folder) == 68
    before = state(folder)
    main(["data", "kitti", str(tmp_path), str(folder), "--projection", "spherical"])
    assert state(folder) == before and "nothing is new: 68 images" in capsys.readouterr().out
    shard = folder / "0000064.npy"
    shard.write_bytes(before[shard.name][:-1] + bytes([before[shard.name][-1] ^ 1]))
    main(["data", "kitti", str(tmp_path), str(folder), "--projection", "spherical", "--check"])
    assert state(folder) == before and "wrote 68 images" in capsys.readouterr().out  # what was mended is said


def test_scans_that_changed_are_made_anew(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    scans(tmp_path, 130)
    velodyne, folder = tmp_path / "sequences" / "00" / "velodyne", tmp_path / "cache"
    words = ["data", "files", str(velodyne), str(folder), "--sensor", "hdl-64e-kitti", "--width", "64"]
    main(words)
    first = state(folder)
    (velodyne / "000100.bin").write_bytes((velodyne / "000101.bin").read_bytes())
    main(words)
    assert capsys.readouterr().out.count("wrote 130 images") == 2
    now = state(folder)
    assert {name for name in first if first[name] != now[name]} == {"0000064.npy", "index.json"}
    assert (CachedImages(folder)[100].range == CachedImages(folder)[101].range).all()
    shutil.copytree(velodyne, tmp_path / "copy")
    words[2] = str(tmp_path / "copy")
    main(words)
    main(words)
    assert capsys.readouterr().out.count("nothing is new: 130 images") == 2
    assert {name for name in now if name != "index.json" and now[name] != state(folder)[name]} == set()
    (tmp_path / "copy" / "000003.bin").write_bytes((velodyne / "000004.bin").read_bytes())
    main(words)
    assert (CachedImages(folder)[3].range == CachedImages(folder)[4].range).all()
    for more, told in (
        (["--split", "val"], "files: expected a split of all, found 'val'"),
        (["--sensor", "hdl-32e"], "expected a cache of sensor {elevations "),
    ):
        with pytest.raises(SystemExit, match="2"):
            main([*words, *more])
        error = capsys.readouterr().err
        assert told in error and len(error) < 700
        assert "name hdl-32e" in error or "split" in error
    for more in (["--split", "train"], ["--projection", "unfolding"], ["--intensity", "byte"]):
        with pytest.raises(SystemExit, match="2"):
            main(["data", "synthetic", str(tmp_path / "streets"), "-n", "2", *more])
        assert f"expected {more[0]} with a data set, found it with synthetic" in capsys.readouterr().err


def test_a_wrong_projection_stops_at_once(tmp_path: Path):
    scans(tmp_path, 70)
    with pytest.raises(ValueError, match=r"projected among 64, found none; the first, 00/000000: unfolding expects"):
        list(cache_source("kitti", tmp_path, tmp_path / "cache"))
    assert not list((tmp_path / "cache").glob("*.npy"))


def limited(words: list[str]) -> None:
    """The command line where no file may be larger than 3 MB."""
    resource.setrlimit(resource.RLIMIT_FSIZE, (3_000_000, 3_000_000))
    main(words)


def test_a_full_disk_is_one_clear_line(tmp_path: Path):
    scans(tmp_path, 130)
    words = ["data", "kitti", str(tmp_path), str(tmp_path / "cache"), "--projection", "spherical", "--workers", "2"]
    done = Forked(*words, run=limited)
    _, errors = done.communicate()
    assert done.returncode == 2, errors
    line = errors.strip().splitlines()[-1]
    assert "Traceback" not in errors
    assert f"{tmp_path}/cache: expected a writable folder with room for 8.0 MiB more, found: File too large" in line
    assert not (tmp_path / "cache" / "0000000.npy").exists() and not list((tmp_path / "cache").glob(".*"))
    main(words)
    assert verify(tmp_path / "cache") == 130


def test_a_disk_that_fills_up_keeps_what_is_whole(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    def full(*_: object) -> None:
        raise OSError(28, "No space left on device")

    writing = write_cache(tmp_path, image, 200, SENSOR, WHAT, name)
    next(writing)
    with monkeypatch.context() as patch:
        patch.setattr(os, "replace", full)
        with pytest.raises(
            OSError, match=r"room for .* MiB more, found: No space left on device; the same command goes on"
        ):
            list(writing)
    assert list(write_cache(tmp_path, image, 200, SENSOR, WHAT, name))[-1] == 200
    assert verify(tmp_path) == 200


def test_a_disk_that_fills_up_at_once_keeps_nothing_unfinished(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    def full(*_: object) -> None:
        (tmp_path / f".0000064.{'a' * 16}.part").touch()  # another worker's, which is ended at once
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, "replace", full)
    with pytest.raises(OSError, match=r"room for .* MiB more"):
        list(write_cache(tmp_path, image, 200, SENSOR, WHAT, name))
    assert list(tmp_path.iterdir()) == []


def test_damage_is_found_and_mended(tmp_path: Path):
    list(write_cache(tmp_path, image, 200, SENSOR, WHAT, name))
    before = state(tmp_path)
    path = tmp_path / "0000064.npy"
    path.write_bytes(before[path.name][:-1] + bytes([before[path.name][-1] ^ 1]))
    with pytest.raises(ValueError, match=r"expected the checksums of index.json, found others in 0000064.npy;"):
        verify(tmp_path)
    list(write_cache(tmp_path, image, 200, SENSOR, WHAT, name, check=True))
    assert state(tmp_path) == before
    path.write_bytes(before[path.name][:-1])
    with pytest.raises(ValueError, match=r"0000064.npy: expected \d+ bytes, found \d+; prepare the cache again"):
        CachedImages(tmp_path)
    list(write_cache(tmp_path, image, 200, SENSOR, WHAT, name))
    assert state(tmp_path) == before


def test_a_folder_of_other_images_is_left_alone(tmp_path: Path):
    list(write_cache(tmp_path, image, 10, SENSOR, WHAT, name))
    with pytest.raises(ValueError, match=r"expected a cache of source \{name other\}, found one of \{name test\}"):
        list(write_cache(tmp_path, image, 10, SENSOR, {"name": "other"}, name))
    with pytest.raises(ValueError, match=r"expected a cache of sensor \{width 64\}, found one of \{width 32\}"):
        list(write_cache(tmp_path, image, 10, SENSOR.resized(width=64), WHAT, name))
    with pytest.raises(
        ValueError, match=r"the scan drive0/000000, as in this cache, found drive0/000007 in its place; name"
    ):
        list(write_cache(tmp_path, image, 10, SENSOR, WHAT, lambda i: name(i + 7)))
    with pytest.raises(ValueError, match=r"expected a cache folder with index.json, found No such file"):
        CachedImages(tmp_path / "nowhere")
    (tmp_path / "scans").mkdir()
    with pytest.raises(
        ValueError, match=r"scans: expected a cache .*, found a folder without; `lidarsynth data` makes"
    ):
        CachedImages(tmp_path / "scans")


def test_images_of_another_shape_than_the_sensor_s_are_refused(tmp_path: Path):
    """They were written, and the cache could not be read."""
    for sensor in (SENSOR.resized(width=64), SENSORS["vlp-16"]):
        with pytest.raises(
            ValueError, match=rf"expected images of \(\d+, {sensor.width}\).* found image 0 of \(8, 32\)"
        ):
            list(write_cache(tmp_path, image, 3, sensor, WHAT))
    assert list(write_cache(tmp_path, image, 3, SENSOR, WHAT)) == [3], "the folder serves"
    assert len(CachedImages(tmp_path)) == 3


def test_a_scan_that_is_gone_from_the_middle_is_named(tmp_path: Path):
    """The message showed the first scans of both, which were the same."""
    list(write_cache(tmp_path, image, 10, SENSOR, WHAT, lambda i: (".", f"{i}.pcd")))
    with pytest.raises(ValueError, match=r"expected the scan 5.pcd, as in this cache, found 6.pcd in its place; name"):
        list(write_cache(tmp_path, image, 9, SENSOR, WHAT, lambda i: (".", f"{i + (i > 4)}.pcd")))


def test_a_cache_of_scans_of_which_the_last_are_gone_is_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    """Of 70 the last ten: the cache had the first 60, and six of those that are gone."""
    scans(tmp_path, 70)
    velodyne, folder = tmp_path / "sequences" / "00" / "velodyne", tmp_path / "cache"
    words = ["data", "files", str(velodyne), str(folder), "--sensor", "hdl-64e-kitti", "--width", "64"]
    main(words)
    before, kept = state(folder), tmp_path / "kept"
    kept.mkdir()
    for i in range(60, 70):
        (velodyne / f"{i:06d}.bin").rename(kept / f"{i:06d}.bin")
    with pytest.raises(SystemExit, match="2"):
        main(words)
    assert "expected the scan 000064.bin, as in this cache, found none in its place; name another folder" in (
        capsys.readouterr().err
    )
    assert state(folder) == before
    for path in sorted(kept.iterdir())[:5]:
        path.rename(velodyne / path.name)
    main(words)  # 65: the last of a shard are made anew without what is gone
    images = CachedImages(folder)
    assert [images.name(i).frame for i in (0, 63, len(images) - 1)] == ["000000.bin", "000063.bin", "000064.bin"]


def test_the_command_line_asks_for_what_it_needs(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    for words, expected in (
        (["kitti", str(tmp_path)], "expected data kitti ROOT CACHE, found no CACHE"),
        (
            ["files", str(tmp_path), str(tmp_path / "cache"), "--workers", "-1"],
            "expected --workers of at least 0, found -1",
        ),
        (["synthetic", str(tmp_path / "cache"), "--workers", "-1"], "expected --workers of at least 0, found -1"),
        (["synthetic", str(tmp_path / "cache"), "--width", "0"], "expected --width of at least 4, found 0"),
    ):
        with pytest.raises(SystemExit) as stop:
            main(["data", *words])
        assert stop.value.code == 2
        assert expected in capsys.readouterr().err


def test_words_are_checked(tmp_path: Path):
    with pytest.raises(ValueError, match=r"expected a source of kitti360, kitti, .* or synthetic, found 'waymo'"):
        list(cache_source("waymo", tmp_path, tmp_path))
    with pytest.raises(ValueError, match="expected a projection of auto, spherical, unfolding, found 'flat'"):
        list(cache_source("kitti", tmp_path, tmp_path, projection="flat"))
    with pytest.raises(SystemExit):
        main(["data", "waymo", "root", "cache"])
    for word in SOURCES:  # the command line's own list has them all
        with pytest.raises(SystemExit) as stop:
            main(["data", word, str(tmp_path / "nowhere"), str(tmp_path / "cache")])
        assert stop.value.code == 2


def test_synthetic_streets_have_labels(tmp_path: Path):
    pytest.importorskip("embreex")
    assert list(cache_synthetic(tmp_path, 2, width=64)) == [(2, 2)]
    label = CachedImages(tmp_path)[0].label
    assert label is not None and 9 in label
    assert summary(tmp_path) == f"2 images in {tmp_path}/"


def test_streets_apart_are_those_of_other_worlds(tmp_path: Path):
    pytest.importorskip("embreex")
    from lidarsynth.streets.reader import SyntheticStreets
    from lidarsynth.streets.world import POSES

    assert list(cache_synthetic(tmp_path / "apart", 2, width=64, seed=3, apart=True)) == [(2, 2)]
    apart = CachedImages(tmp_path / "apart")
    together = SyntheticStreets(seed=3, sensor=apart.sensor)
    np.testing.assert_allclose(apart[1].range, together.image(POSES + 1).range, atol=1e-3)
    with pytest.raises(ValueError, match="expected a cache of source"):
        list(cache_synthetic(tmp_path / "apart", 2, width=64, seed=3))
    with pytest.raises(ValueError, match="expected --apart with synthetic"):
        prepare("files", tmp_path, tmp_path / "x", apart=True)


def untold(folder: Path) -> None:
    """The cache as it was before 2026-11-26, when none told the edition of its streets."""
    index = json.loads((folder / "index.json").read_text())
    del index["source"]["edition"]
    (folder / "index.json").write_text(json.dumps(index))


def test_no_cache_of_a_sensor_of_ones_own_mixes_images_with_those_of_before_each_firing_had_a_column(tmp_path: Path):
    (tmp_path / "scans").mkdir()
    write(tmp_path / "scans" / "a.npz", image(0))
    list(cache_source("files", str(tmp_path / "scans"), tmp_path / "own", sensor=SENSOR))
    index = read_index(tmp_path / "own")
    assert SENSOR.name not in SENSORS and index["source"].pop("firings")
    (tmp_path / "own" / "index.json").write_text(json.dumps(index))
    with pytest.raises(
        ValueError, match=r"expected a cache of source \{firings .*\}, found one of \{firings None\}; name"
    ):
        list(cache_source("files", str(tmp_path / "scans"), tmp_path / "own", sensor=SENSOR))
    list(cache_source("files", str(tmp_path / "scans"), tmp_path / "known", sensor="vlp-16"))
    assert "firings" not in read_index(tmp_path / "known")["source"], "images of known sensors are as they were"


def test_no_cache_mixes_two_editions_of_the_streets(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    pytest.importorskip("embreex")
    list(cache_synthetic(tmp_path / "new", 1, width=64, seed=3))
    shutil.copytree(tmp_path / "new", tmp_path / "older")
    untold(tmp_path / "older")
    assert list(cache_synthetic(tmp_path / "older", 2, width=64, seed=3))[-1] == (2, 2), "today's streets are the same"
    assert "edition" not in read_index(tmp_path / "older")["source"] and len(CachedImages(tmp_path / "older")) == 2
    monkeypatch.setattr("lidarsynth.data.sources.EDITION", 3)
    with pytest.raises(ValueError, match=r"expected a cache of source \{edition 3\}, found one of \{edition 2\}"):
        list(cache_synthetic(tmp_path / "new", 2, width=64, seed=3))
    assert len(CachedImages(tmp_path / "new")) == 1


def test_a_cache_of_older_streets_is_read_and_not_added_to(tmp_path: Path):
    pytest.importorskip("embreex")
    from lidarsynth.streets.reader import SyntheticStreets

    streets = SyntheticStreets(seed=4, sensor=SENSORS["hdl-64e-kitti"].resized(width=64))
    list(write_cache(tmp_path, streets.image, 1, streets.sensor, {"name": "synthetic", "seed": 3}))
    before = state(tmp_path)
    for count in (1, 2):
        with pytest.raises(ValueError, match=r"expected a cache of streets of edition .*, found one of other streets"):
            list(cache_synthetic(tmp_path, count, width=64, seed=3))
    assert state(tmp_path) == before and len(CachedImages(tmp_path)) == 1
    (tmp_path / "0000000.npy").write_bytes(b"damaged")
    assert list(cache_synthetic(tmp_path, 2, width=64, seed=3))[-1] == (2, 2), "all of it is made anew"


@pytest.mark.parametrize(
    ("method", "columns", "size", "codec", "key"),
    [
        ("unfolding", 2048, (64, 512), "log", "train_x0.unfolding-2048.to64x512.log_depth"),
        ("spherical", 1024, (64, 256), "log", "train_x0.spherical-1024.to64x256.log_depth"),
        ("spherical", 1024, (32, 128), "metric", "train_x0.spherical-1024.to32x128.depth"),
        ("spherical", 1024, (32, 128), "inverse", "train_x0.spherical-1024.to32x128.inverse_depth"),
    ],
)
def test_training_images_are_the_published_ones(scan64: bytes, fixture_tensors, method, columns, size, codec, key):
    expected = fixture_tensors("projection/preprocess")[key][0]
    table = np.frombuffer(scan64, "<f4").reshape(-1, 4)
    scan = Scan(table[:, :3], table[:, 3])
    small = thin(project(scan, SENSORS["hdl-64e"], method, columns), *size)
    assert small.shape == size == (small.sensor.height, small.sensor.width)
    assert_close(to_x_0(small, codec), expected, rtol=0, atol=1e-5)


def test_a_cache_of_kitti_raw_is_the_papers(scan64: bytes, fixture_tensors, tmp_path: Path):
    folder = tmp_path / "2011_10_03" / "2011_10_03_drive_0027_sync" / "velodyne_points" / "data"
    folder.mkdir(parents=True)
    (folder / "0000000000.bin").write_bytes(scan64)
    main(["data", "kitti", str(tmp_path), str(tmp_path / "cache"), "--sensor", "hdl-64e"])
    images = CachedImages(tmp_path / "cache")
    assert (images.source["projection"], images.source["columns"], images[0].shape) == ("unfolding", 2048, (64, 512))
    expected = fixture_tensors("projection/preprocess")["train_x0.unfolding-2048.to64x512.log_depth"][0]
    x_0 = images.x_0([0])[0]
    # 1 mm at 1.45 m is 1.3e-4 of the logarithm's range, twice that of [-1, 1]; half a step of reflectance is 1/255.
    assert_close(x_0[0], expected[0], rtol=0, atol=2 * 0.001 / (2.45 * np.log(81)) + 1e-6)
    assert_close(x_0[1], expected[1], rtol=0, atol=1 / 255 + 1e-6)
    kept = ~expected[0].isnan()
    assert ((x_0[0] == -1) == (expected[0] == -1))[kept].all()


def kitti_of(scan64: bytes, root: Path) -> Path:
    """A root with that scan as the first of KITTI's raw training drives."""
    folder = root / "2011_10_03" / "2011_10_03_drive_0027_sync" / "velodyne_points" / "data"
    folder.mkdir(parents=True)
    (folder / "0000000000.bin").write_bytes(scan64)
    return root


def test_a_cache_of_dusty_keeps_the_columns_of_its_program(scan64: bytes, tmp_path: Path):
    """Nearest resizing takes columns 0, 4, 8 of 2048, and nearest-exact, R2DM's, 2, 6, 10."""
    root, table = kitti_of(scan64, tmp_path), np.frombuffer(scan64, "<f4").reshape(-1, 4)
    wide = project(Scan(table[:, :3], table[:, 3]), "hdl-64e-dusty", "unfolding", 2048)
    for word, mode in (("kitti-dusty", "nearest"), ("kitti-r2dm", "nearest-exact")):
        main(["data", word, str(root), str(tmp_path / word)])
        image = CachedImages(tmp_path / word)[0]
        expected = torch.nn.functional.interpolate(torch.from_numpy(wide.range)[None, None], (64, 512), mode=mode)
        np.testing.assert_allclose(image.range, expected[0, 0], atol=0.00101)
        assert image.sensor.name == f"hdl-64e-{word.removeprefix('kitti-')}"
    small = thin(wide, 16, 512, "nearest")
    np.testing.assert_array_equal(small.range, wide.range[::4, ::4])
    with pytest.raises(ValueError, match=r"expected a resizing of nearest-exact, nearest, found 'bilinear'"):
        thin(wide, width=512, resizing="bilinear")


def test_images_of_published_systems_are_of_raw_drives(scan64: bytes, tmp_path: Path):
    """Odometry's points are motion-compensated, and its test split is of other drives."""
    folder = tmp_path / "odometry" / "sequences" / "00" / "velodyne"
    folder.mkdir(parents=True)
    (folder / "000000.bin").write_bytes(scan64)
    for word in ("kitti-dusty", "kitti-r2dm"):
        with pytest.raises(ValueError, match=r"expected raw drives, DATE/DATE_drive_NNNN_sync, .* found odometry's"):
            list(cache_source(word, tmp_path / "odometry", tmp_path / word))
    assert list(cache_source("kitti", tmp_path / "odometry", tmp_path / "kitti", sensor="hdl-64e-dusty"))


def test_a_frame_that_has_no_number_is_named(scan64: bytes, tmp_path: Path):
    root = kitti_of(scan64, tmp_path)
    notes = root / "2011_10_03/2011_10_03_drive_0027_sync/velodyne_points/data/notes.bin"
    notes.write_bytes(scan64)
    with pytest.raises(ValueError, match=r"notes.bin: expected a file named by the number of its frame, found 'notes'"):
        list(cache_source("kitti", root, tmp_path / "cache"))


def test_a_cache_of_lidargen_is_of_its_drives_and_without_limits(scan64: bytes, tmp_path: Path):
    """Its program trains on all names without 0000_sync and 0001_sync, and drops no return for its range."""
    for drive in (0, 2, 3):
        folder = tmp_path / f"data_3d_raw/2013_05_28_drive_{drive:04d}_sync/velodyne_points/data"
        folder.mkdir(parents=True)
        (folder / "0000000000.bin").write_bytes(scan64)
    main(["data", "kitti360-lidargen", str(tmp_path), str(tmp_path / "cache")])
    images = CachedImages(tmp_path / "cache")
    assert [images.name(i).sequence[-9:] for i in range(len(images))] == ["0002_sync", "0003_sync"]
    assert images[0].range.max() > 80 and 0 < images[0].range[images[0].mask].min() < 1.45
    main(["data", "kitti360-lidargen", str(tmp_path), str(tmp_path / "test"), "--split", "test"])
    assert CachedImages(tmp_path / "test").name(0).sequence[-9:] == "0000_sync"


def test_real_beams_keep_their_angles_when_thinned():
    beams = SENSORS["hdl-64e-kitti"]
    rows = np.broadcast_to(np.arange(64, dtype=np.float32)[:, None], (64, 1024))
    tall = RangeImage(rows, np.zeros_like(rows), rows > 0, beams, rows.astype(int), np.stack([rows] * 3, axis=-1))
    small = thin(tall, 16, 256)
    assert small.sensor == beams.resized(16, 256)
    assert [beams.elevations[int(row)] for row in small.range[:, 0]] == list(small.sensor.elevations)
    assert small.label is not None and small.xyz is not None
    np.testing.assert_array_equal(small.label, small.range)
    np.testing.assert_array_equal(small.xyz[..., 2], small.range)


def test_a_narrow_cache_keeps_the_ray_drop(scan64: bytes):
    """A pixel of 64 x 512 is one pixel of the turn, so as many are empty; drawing at 512 columns would fill them."""
    table = np.frombuffer(scan64, "<f4").reshape(-1, 4)
    scan = Scan(table[:, :3], table[:, 3])
    sensor = SENSORS["hdl-64e"].resized(width=512)
    thinned = Projected([scan], sensor, "unfolding", 2048)(0)
    turn = project(scan, sensor, "unfolding", 2048)
    assert abs(thinned.mask.mean() - turn.mask.mean()) < 0.01
    assert project(scan, sensor, "unfolding").mask.mean() > turn.mask.mean() + 0.05


def without_intensity(path: Path, sensor: Sensor) -> None:
    """An ascii `.pcd` of x, y, z and ring: 20 m in every direction."""
    distance = np.full((sensor.height, sensor.width), 20, np.float32)
    scan = RangeImage(distance, 0 * distance, distance > 0, sensor).to_scan()
    assert scan.ring is not None
    rows = [" ".join(map(str, [*xyz, ring])) for xyz, ring in zip(scan.xyz, scan.ring, strict=True)]
    head = "VERSION 0.7\nFIELDS x y z ring\nSIZE 4 4 4 2\nTYPE F F F U\nCOUNT 1 1 1 1\n"
    size = f"WIDTH {len(rows)}\nHEIGHT 1\nVIEWPOINT 0 0 0 1 0 0 0\nPOINTS {len(rows)}\nDATA ascii\n"
    path.write_text(head + size + "\n".join(rows) + "\n")


def test_files_without_intensity_are_read_when_told_so(tmp_path: Path):
    (tmp_path / "scans").mkdir()
    without_intensity(tmp_path / "scans/0.pcd", SENSORS["vlp-16"].resized(width=32))
    words = ("files", tmp_path / "scans", tmp_path / "cache")
    with pytest.raises(ValueError, match="expected an intensity field"):
        list(cache_source(*words, sensor="vlp-16", width=32))
    list(cache_source(*words, sensor="vlp-16", width=32, intensity="none"))  # nothing was stored: the folder serves
    image = CachedImages(tmp_path / "cache")[0]
    assert image.mask.mean() > 0.9 and not image.reflectance.any()
    with pytest.raises(ValueError, match=r"expected --intensity with files.* found it with kitti"):
        list(cache_source("kitti", tmp_path, tmp_path / "c", intensity="none"))


def test_files_in_another_frame_are_told_of_and_taken_with_a_transform(tmp_path: Path, capsys):
    """They lost the points that were out of view, without the transform that undoes it, and could not be given any."""
    (tmp_path / "own").mkdir()
    (tmp_path / "away").mkdir()
    scan = street("hdl-32e")
    for i in range(3):
        write(tmp_path / f"own/{i}.ply", scan)
        write(tmp_path / f"away/{i}.ply", moved(scan, parse_transform("1.5:0:2.3:0:0:0")))
    words = ["--sensor", "hdl-32e", "--workers", "0"]
    main(["data", "files", str(tmp_path / "own"), str(tmp_path / "cache-own"), *words])
    assert capsys.readouterr().err.count("\n") == 0
    main(["data", "files", str(tmp_path / "away"), str(tmp_path / "cache-away"), *words])
    (line,) = capsys.readouterr().err.splitlines()
    assert "away/0.ply: expected points in the sensor's frame" in line and "try --transform -1.5:0:-2.3" in line
    assert "3 of 3 scans that were looked at are so, and drawn all the same" in line
    move = ["--transform=-1.5:0:-2.3:0:0:0"]
    main(["data", "files", str(tmp_path / "away"), str(tmp_path / "cache"), *words, *move])
    assert capsys.readouterr().err == ""
    own, back = CachedImages(tmp_path / "cache-own")[0], CachedImages(tmp_path / "cache")[0]
    assert (own.mask == back.mask).mean() > 0.99
    main(["data", "files", str(tmp_path / "away"), str(tmp_path / "cache"), *words, *move])
    assert capsys.readouterr().out.startswith("nothing is new")
    with pytest.raises(SystemExit):
        main(["data", "files", str(tmp_path / "away"), str(tmp_path / "cache"), *words])
    assert "expected a cache of source {transform None}, found one of {transform [[1.0" in capsys.readouterr().err


def test_scans_of_another_sensor_among_files_are_told_of(tmp_path: Path):
    """Only the first was looked at, and of that only its view."""
    own, other = (Sensor("own", tuple(np.linspace(top, -14, n)), 128) for top, n in ((15, 24), (13, 9)))
    for i in range(20):
        without_intensity(tmp_path / f"{i:02d}.pcd", other if i > 16 else own)
    (tmp_path / "own.toml").write_text("beams = 24\ntop = 15\nbottom = -14\nwidth = 128\n")
    line = unfit("files", tmp_path, str(tmp_path / "own.toml"), "none")
    assert line is not None and "18.pcd: expected points of own, found them on 9 rings that are not on its 24" in line
    assert "1 of 7 scans that were looked at" in line
    assert unfit("kitti", tmp_path, None) is None


def test_some_rings_of_files_of_several_sensors_are_taken(tmp_path: Path):
    (tmp_path / "scans").mkdir()
    two = Sensor("two", tuple(np.linspace(15, -15, 32)), 64)
    without_intensity(tmp_path / "scans/0.pcd", two)
    first = two.rows(range(16))
    (tmp_path / "first.json").write_text(json.dumps(first.to_dict()))
    words = ("files", tmp_path / "scans", tmp_path / "cache", "all", str(tmp_path / "first.json"))
    list(cache_source(*words, intensity="none", rings=(0, 15)))
    assert CachedImages(tmp_path / "cache").source["rings"] == [0, 15]
    assert CachedImages(tmp_path / "cache")[0].mask.sum() == 16 * 64
    for word, more in (("--rings", {"rings": (0, 15)}), ("--transform", {"transform": np.eye(4)})):
        with pytest.raises(ValueError, match=rf"expected {word} with files.* found it with kitti"):
            list(cache_source("kitti", tmp_path, tmp_path / "c", **more))
        with pytest.raises(ValueError, match=rf"expected {word} with a data set, found it with synthetic"):
            prepare("synthetic", tmp_path / "c", None, **more)


def test_the_sensor_of_files_is_recognised_or_asked_for(tmp_path: Path):
    (tmp_path / "known").mkdir()
    (tmp_path / "known/0.pcd").write_text("not a scan")  # skipped, like any broken one
    without_intensity(tmp_path / "known/1.pcd", SENSORS["vlp-16"].resized(width=64))
    list(cache_source("files", tmp_path / "known", tmp_path / "cache", width=64, intensity="none"))
    assert CachedImages(tmp_path / "cache").sensor == SENSORS["vlp-16"].resized(width=64)
    (tmp_path / "own").mkdir()
    own = Sensor("own", tuple(np.linspace(20, -31, 24)), 64)
    without_intensity(tmp_path / "own/0.pcd", own)
    with pytest.raises(ValueError, match=r"0.pcd: expected the beams of .* name the sensor with --sensor"):
        list(cache_source("files", tmp_path / "own", tmp_path / "none", width=64, intensity="none"))
    assert not (tmp_path / "none").exists()


def test_the_width_is_the_given_one_else_that_of_one_s_own_sensor(tmp_path: Path):
    (tmp_path / "own.toml").write_text("beams = 16\ntop = 15\nbottom = -15\nwidth = 48\n")
    (tmp_path / "scans").mkdir()
    without_intensity(tmp_path / "scans/0.pcd", SENSORS["vlp-16"].resized(width=64))
    for sensor, given, expected in (("own.toml", None, 48), ("own.toml", 32, 32), ("vlp-16", None, 1024)):
        word = str(tmp_path / sensor) if sensor == "own.toml" else sensor
        folder = tmp_path / f"cache-{expected}"
        list(cache_source("files", tmp_path / "scans", folder, sensor=word, width=given, intensity="none"))
        assert CachedImages(folder).sensor.width == expected


def test_files_and_streets_have_as_many_columns_as_the_sensor(tmp_path: Path):
    """Of the sensor that `generate` draws: 1,024 were no reference for a Pandar64's 1,800."""
    (tmp_path / "scans").mkdir()
    without_intensity(tmp_path / "scans/0.pcd", SENSORS["pandar64"])
    list(prepare("files", tmp_path / "scans", tmp_path / "files", sensor="pandar64", intensity="none"))
    list(prepare("synthetic", tmp_path / "streets", None, sensor="pandar64", count=1))
    list(cache_synthetic(tmp_path / "python", 1, "pandar64"))
    for folder in ("files", "streets", "python"):
        assert CachedImages(tmp_path / folder).sensor.width == 1800


def test_a_sensor_that_sees_200_metres_keeps_them(tmp_path: Path):
    """Ranges beyond 131 m were cut silently; the step is in the index now, and an index without one means 2 mm."""
    sensor = replace(SENSOR, max_range=250.0)
    far = RangeImage(*(np.full((8, 32), v, np.float32) for v in (249.9, 0.5)), np.ones((8, 32), bool), sensor)
    list(write_cache(tmp_path, lambda i: far, 1, sensor, WHAT))
    assert read_index(tmp_path)["step"] == 0.004
    assert abs(CachedImages(tmp_path)[0].range - 249.9).max() <= 0.002
    x_0 = CachedImages(tmp_path).x_0([0])
    assert abs(x_0[0, 0] - to_x_0(far, "log")[0]).max() < 1e-4
    index = json.loads((tmp_path / "index.json").read_text())
    del index["step"]
    (tmp_path / "index.json").write_text(json.dumps(index))
    assert abs(CachedImages(tmp_path)[0].range - 249.9 / 2).max() < 0.01


def test_a_range_that_does_not_fit_is_refused():
    far = RangeImage(*(np.full((8, 32), v, np.float32) for v in (140.0, 0.5)), np.ones((8, 32), bool), SENSOR)
    with pytest.raises(ValueError, match=r"expected ranges up to 131.07 m, found 140"):
        cache.pack(far)


@pytest.mark.parametrize("step", ["2 mm", True, 0.0, -0.002, 7.0])
def test_an_index_with_a_step_that_is_none_is_refused(tmp_path: Path, step: object):
    list(write_cache(tmp_path, image, 1, SENSOR, WHAT))
    index = json.loads((tmp_path / "index.json").read_text()) | {"step": step}
    (tmp_path / "index.json").write_text(json.dumps(index))
    with pytest.raises(ValueError, match=r"expected a step of 0 to 1 m, found"):
        CachedImages(tmp_path)
