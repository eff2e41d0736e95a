"""KITTI: raw drives, and the odometry benchmark's sequences with SemanticKITTI's labels."""

from __future__ import annotations

from pathlib import Path

from lidarsynth.data.frames import Frame, Frames, choose, gather, list_frames

SPLITS = ("train", "val", "test", "all")
DRIVES = "*/*_drive_*_sync"  # of the raw data

# Odometry sequence -> drive of the raw data, first and last frame (KITTI's development kit). Sequence 03 is not in the
# raw data any more; R2DM trains without it: 18,329 scans.
ODOMETRY_TO_RAW: dict[str, tuple[str, int, int]] = {
    "00": ("2011_10_03_drive_0027_sync", 0, 4540),
    "01": ("2011_10_03_drive_0042_sync", 0, 1100),
    "02": ("2011_10_03_drive_0034_sync", 0, 4660),
    "03": ("2011_09_26_drive_0067_sync", 0, 800),
    "04": ("2011_09_30_drive_0016_sync", 0, 270),
    "05": ("2011_09_30_drive_0018_sync", 0, 2760),
    "06": ("2011_09_30_drive_0020_sync", 0, 1100),
    "07": ("2011_09_30_drive_0027_sync", 0, 1100),
    "08": ("2011_09_30_drive_0028_sync", 1100, 5170),
    "09": ("2011_09_30_drive_0033_sync", 0, 1590),
    "10": ("2011_09_30_drive_0034_sync", 0, 1200),
}
RAW_TRAIN = ("00", "01", "02", "04", "05", "06", "07", "09", "10")
RAW_VAL = ("08",)
RAW_TEST: dict[str, dict[str, tuple[int, ...]]] = {  # category -> date -> drives: all that odometry does not use
    "city": {
        "2011_09_26": (1, 2, 5, 9, 11, 13, 14, 17, 18, 48, 51, 56, 57, 59, 60, 84, 91, 93, 95, 96, 104, 106, 113, 117),
        "2011_09_28": (1, 2),
        "2011_09_29": (26, 71),
    },
    "road": {"2011_09_26": (15, 27, 28, 29, 32, 52, 70, 101), "2011_09_29": (4,), "2011_10_03": (47,)},
    "residential": {"2011_09_26": (19, 20, 22, 23, 35, 36, 39, 46, 61, 64, 79, 86, 87)},
}
ODOMETRY_SPLITS: dict[str, tuple[str, ...]] = {  # SemanticKITTI's; the test sequences have no public labels
    "train": ("00", "01", "02", "03", "04", "05", "06", "07", "09", "10"),
    "val": ("08",),
    "test": tuple(f"{i:02d}" for i in range(11, 22)),
}


def kitti(root: str | Path, split: str = "train") -> Frames:
    """The reader for whichever of KITTI's layouts `root` has: `kitti_odometry` or `kitti_raw`.

    Raises ValueError when it has neither.
    """
    root = Path(root)
    if _sequences(root).is_dir():
        return kitti_odometry(root, split)
    if any(root.glob(DRIVES)):
        return kitti_raw(root, split)
    raise ValueError(f"{root}: expected DATE/DATE_drive_NNNN_sync (raw) or sequences/NN (odometry), found neither")


def kitti_raw(root: str | Path, split: str = "train") -> Frames:
    """Raw drives: ROOT/2011_09_26/2011_09_26_drive_0001_sync/velodyne_points/data/0000000000.bin.

    split  R2DM's `train` and `val`, the frames of the odometry sequences RAW_TRAIN and RAW_VAL, and its `test`, the 51
           drives of RAW_TEST in that order; `all`: every drive there is
    Points are not motion-compensated. Raises ValueError when the split has no scan here.
    """
    root = Path(root)
    choose("kitti", split, SPLITS)
    if split == "all":
        wanted = [(path.name, 0, None) for path in sorted(root.glob(DRIVES))]
    elif split == "test":
        wanted = [(drive, 0, None) for drive in raw_test_drives()]
    else:
        wanted = [ODOMETRY_TO_RAW[sequence] for sequence in (RAW_TRAIN if split == "train" else RAW_VAL)]
    frames = {drive: _drive(root, drive, first, last) for drive, first, last in wanted}
    return gather("kitti", root, split, frames)


def kitti_published(root: str | Path, split: str = "train") -> Frames:
    """`kitti_raw`, on which published systems learned. Raises ValueError for odometry's layout, of other points, and
    where there is no drive."""
    if not _sequences(Path(root)).is_dir() and not any(Path(root).glob(DRIVES)):
        raise ValueError(f"{root}: expected raw drives, DATE/DATE_drive_NNNN_sync, found none")
    if _sequences(Path(root)).is_dir():
        raise ValueError(f"{root}: expected raw drives, DATE/DATE_drive_NNNN_sync, on which published systems learned, "
                         "found odometry's sequences, whose points are motion-compensated and whose splits are others: "
                         "data kitti takes them, with --sensor")  # fmt: skip
    return kitti_raw(root, split)


def raw_test_drives() -> list[str]:
    """The 51 drives of R2DM's test split, city, road, then residential."""
    dates = [(date, drives) for dates in RAW_TEST.values() for date, drives in dates.items()]
    return [f"{date}_drive_{drive:04d}_sync" for date, drives in dates for drive in drives]


def _drive(root: Path, drive: str, first: int, last: int | None) -> list[Frame]:
    frames = list_frames(root / drive[:10] / drive / "velodyne_points" / "data", drive)
    for frame in frames if last is not None else ():
        if not frame.frame.isdecimal():
            raise ValueError(f"{frame.path}: expected a file named by the number of its frame, found {frame.frame!r}")
    return frames if last is None else [frame for frame in frames if first <= int(frame.frame) <= last]


def kitti_odometry(root: str | Path, split: str = "train") -> Frames:
    """Odometry and SemanticKITTI: ROOT[/dataset]/sequences/00/velodyne/000000.bin and .../labels/000000.label if there.

    split  SemanticKITTI's ODOMETRY_SPLITS, or `all`
    Points are motion-compensated; labels become training classes 0-19.
    Raises ValueError when the split has no scan here.
    """
    folder = _sequences(Path(root))
    choose("kitti", split, SPLITS)
    names = [p.name for p in sorted(folder.glob("[0-9][0-9]"))] if split == "all" else ODOMETRY_SPLITS[split]
    frames = {n: list_frames(folder / n / "velodyne", n, labels=folder / n / "labels") for n in names}
    return gather("kitti", Path(root), split, frames)


def _sequences(root: Path) -> Path:
    inner = root / "dataset" / "sequences"
    return inner if inner.is_dir() else root / "sequences"
