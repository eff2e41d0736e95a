"""Angle correction files of Hesai's sensors: `.csv` of each channel's elevation and azimuth offset.

The makers' manuals have them: a line `Laser id,Elevation,Azimuth` or `Channel,Elevation,Azimuth`, then one a channel,
degrees. Each unit has its own, which its web page exports.
"""

from __future__ import annotations

from math import isfinite
from pathlib import Path
from typing import NamedTuple

from lidarsynth.files.fields import FileError
from lidarsynth.lidar.small_file import check_regular, read_text

CHANNEL = ("laser id", "channel")
HEAD = 4096  # bytes that hold the names of the columns
BEFORE = 4  # lines that may stand before these
HOW = "the unit's web page exports it, or its maker sends it"


class Angles(NamedTuple):
    """Degrees of each channel: above the horizon, and clockwise beside the block's azimuth."""

    elevations: tuple[float, ...]
    azimuths: tuple[float, ...]


def is_angles(path: str | Path) -> bool:
    """Whether a `.csv` file is an angle correction file, by the names of its columns."""
    path = Path(path)
    if path.suffix.lower() != ".csv":
        return False
    try:
        check_regular(path)
        with path.open("rb") as file:
            text = file.read(HEAD).decode("utf-8-sig", "replace")
    except (OSError, ValueError):
        return False
    return _header(text.splitlines()) is not None


def read_angles(path: str | Path) -> Angles:
    """The angles in a file, by channel, in whatever order they stand. Raises FileError for a file that has not one line
    of finite angles for each."""
    path = Path(path)
    try:
        lines = read_text(path).splitlines()
    except OSError as error:
        raise FileError(f"{path}: expected a readable file, found: {error.strerror}") from None
    except ValueError as error:
        raise FileError(f"{error}; it should be an angle correction file of a Hesai sensor") from None
    if (header := _header(lines)) is None:
        raise FileError(f"{path}: expected an angle correction file of a Hesai sensor, with the columns Channel, "
                        f"Elevation and Azimuth, found {(lines or ['nothing'])[0]!r:.80}")  # fmt: skip
    at, columns = header
    found: dict[int, tuple[float, float]] = {}
    for number, line in enumerate(lines[at + 1 :], at + 2):
        if line.strip(" ,\t"):
            channel, *angles = _row(f"{path}: line {number}", line, columns)
            if channel in found:
                raise FileError(f"{path}: line {number}: expected each channel once, found {channel} again")
            found[channel] = (angles[0], angles[1])
    first = min(found, default=1)
    if first not in (0, 1) or sorted(found) != list(range(first, first + len(found))) or not found:
        raise FileError(f"{path}: expected channels that count from 1, found {_listed(sorted(found))}")
    elevations, azimuths = zip(*(found[channel] for channel in sorted(found)), strict=True)
    return Angles(elevations, azimuths)


def _listed(channels: list[int]) -> str:
    gap = next((c for c in range(channels[0], channels[-1]) if c not in channels), None) if channels else None
    return f"{channels[0]} to {channels[-1]}" + (f" without {gap}" if gap is not None else "") if channels else "none"


def _header(lines: list[str]) -> tuple[int, tuple[int, int, int]] | None:
    """Which line names the columns, and where channel, elevation and azimuth stand; None for another file's."""
    for at, line in enumerate(lines[: BEFORE + 1]):
        names = [word.strip().strip('"').lower() for word in line.split(",")]
        channel = next((names.index(word) for word in CHANNEL if word in names), None)
        if channel is not None and {"elevation", "azimuth"} <= set(names) and not {"x", "y", "z"} & set(names):
            return at, (channel, names.index("elevation"), names.index("azimuth"))
    return None


def _row(where: str, line: str, columns: tuple[int, int, int]) -> tuple[int, float, float]:
    words = [word.strip().strip('"') for word in line.split(",")]
    try:
        channel, elevation, azimuth = int(words[columns[0]]), float(words[columns[1]]), float(words[columns[2]])
    except (ValueError, IndexError):
        raise FileError(f"{where}: expected a channel and two angles, found {line!r:.80}") from None
    if not (isfinite(elevation) and isfinite(azimuth) and abs(elevation) <= 90 and abs(azimuth) <= 180):
        raise FileError(f"{where}: expected degrees within +-90 and +-180, found {line!r:.80}")
    return channel, elevation, azimuth


def angles_beside(path: Path, channels: int, model: str) -> Angles | None:
    """Those of a sensor of so many channels, in the only file for it in the folder of a recording, or in that which
    the recording is; None where none is for it. Raises FileError where several are, which lists them, or one is broken
    and none fits."""
    folders = [path.parent, path] if path.is_dir() else [path.parent]
    files = [file for one in folders for file in sorted(one.glob("*.[cC][sS][vV]")) if is_angles(file)]
    read: dict[Path, Angles] = {}
    broken: list[FileError] = []
    for file in files:
        try:
            read[file] = read_angles(file)
        except FileError as error:
            broken.append(error)
    fit = [file for file, angles in read.items() if len(angles.elevations) == channels]
    named = [file for file in fit if file.stem.startswith(path.stem) or path.stem.startswith(file.stem)]
    if len(named or fit) == 1:
        return read[(named or fit)[0]]
    if fit:
        listed = ", ".join(file.name for file in named or fit)
        raise FileError(f"{path}: expected --metadata ANGLES.csv, the angle correction file of the {model}, found "
                        f"several beside it: {listed}")  # fmt: skip
    if broken:
        raise broken[0]
    return None
