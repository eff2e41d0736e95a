"""KITTI-360: the Velodyne turns of nine drives."""

from __future__ import annotations

from pathlib import Path

from lidarsynth.data.frames import Frames, choose, gather, list_frames

SPLITS: dict[str, tuple[int, ...]] = {  # R2DM's; 81,106 scans in all
    "train": (3, 4, 5, 6, 7, 9, 10),
    "test": (0, 2),
    "all": (3, 4, 5, 6, 7, 9, 10, 0, 2),
}
# LiDARGen's paper tests on 0 and 2; its program on names with 0000_sync or 0001_sync, and there is no drive 1.
LIDARGEN_SPLITS: dict[str, tuple[int, ...]] = {
    "train": (2, 3, 4, 5, 6, 7, 9, 10),
    "test": (0,),
    "all": (0, 2, 3, 4, 5, 6, 7, 9, 10),
}


def kitti360(root: str | Path, split: str = "train") -> Frames:
    """ROOT/data_3d_raw/2013_05_28_drive_0003_sync/velodyne_points/data/0000000000.bin; ROOT may be data_3d_raw itself.

    split  a word of SPLITS. Points are not motion-compensated; single turns have no labels in this data set.
    Raises ValueError when the split has no scan here.
    """
    return _read(Path(root), "kitti360", split, SPLITS)


def kitti360_lidargen(root: str | Path, split: str = "train") -> Frames:
    """`kitti360` with LIDARGEN_SPLITS."""
    return _read(Path(root), "kitti360-lidargen", split, LIDARGEN_SPLITS)


def _read(root: Path, source: str, split: str, splits: dict[str, tuple[int, ...]]) -> Frames:
    choose(source, split, tuple(splits))
    inner = root / "data_3d_raw"
    folder = inner if inner.is_dir() else root
    if not any(folder.glob("*_drive_*_sync")):
        raise ValueError(f"{root}: expected drives, data_3d_raw/2013_05_28_drive_NNNN_sync, found none")
    frames = {}
    for sequence in splits[split]:
        drives = sorted(folder.glob(f"*_{sequence:04d}_sync"))
        for drive in drives:
            frames[drive.name] = list_frames(drive / "velodyne_points" / "data", drive.name)
        if not drives:
            frames[f"{sequence:04d}"] = []
    return gather(source, root, split, frames)
