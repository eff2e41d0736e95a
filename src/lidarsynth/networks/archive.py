"""The files of published weights, by name, from a `.tar.gz` or a folder: read in memory, nothing is unpacked."""

from __future__ import annotations

import tarfile
import zlib
from collections.abc import Collection, Mapping
from pathlib import Path, PurePosixPath
from typing import Any

LARGEST_YAML = 1 << 16  # bytes, and values; published files have some thousand


def weight_files(path: str | Path, largest: Mapping[str, int], needed: Collection[str], what: str) -> dict[str, bytes]:
    """Contents of the files of these names; of others, and of those that are neither there nor `needed`, nothing.

    largest  name -> the most bytes it may have
    what     names the archive in errors, such as "RangeNet"
    Raises ValueError when the archive is damaged, lacks a needed file, or holds links or paths that lead outside.
    """
    path = Path(path)
    files = _of_folder(path, largest) if path.is_dir() else _of_archive(path, largest, what)
    absent = [name for name in largest if name in needed and name not in files]
    if absent:
        raise ValueError(f"{path}: expected the files {', '.join(n for n in largest if n in needed)}, "
                         f"found no {', '.join(absent)}")  # fmt: skip
    return files


def _of_folder(path: Path, largest: Mapping[str, int]) -> dict[str, bytes]:
    files = {}
    for name in [name for name in largest if (path / name).is_file()]:
        if (size := (path / name).stat().st_size) > largest[name]:
            raise ValueError(f"{path}: expected {name} of at most {largest[name]} bytes, found {size}")
        files[name] = (path / name).read_bytes()
    return files


def _of_archive(path: Path, largest: Mapping[str, int], what: str) -> dict[str, bytes]:
    files: dict[str, bytes] = {}
    try:
        with tarfile.open(path, "r:*") as archive:
            for member in archive:
                name = PurePosixPath(member.name).name
                if name in largest:
                    _check_member(path, member, name in files, largest[name])
                    content = archive.extractfile(member)
                    files[name] = content.read() if content else b""
    except (OSError, EOFError, tarfile.TarError, zlib.error) as error:
        reason = error.strerror if isinstance(error, OSError) and error.strerror else " ".join(str(error).split())
        raise ValueError(f"{path}: expected a {what} archive (.tar.gz), found {reason:.120}") from None
    return files


def _check_member(path: Path, member: tarfile.TarInfo, twice: bool, largest: int) -> None:
    place = PurePosixPath(member.name)
    if not member.isfile() or place.is_absolute() or ".." in place.parts or twice:
        raise ValueError(f"{path}: expected each file once, in one folder, found {member.name!r:.80} "
                         f"({'again' if twice else 'a link or a path that leads outside'})")  # fmt: skip
    if member.size > largest:
        raise ValueError(f"{path}: expected {place.name} of at most {largest} bytes, found {member.size}")


def read_yaml(text: bytes, where: str) -> Any:
    """A small YAML file. Raises ValueError that begins with `where`, also for one that aliases make large; ImportError
    without pyyaml.
    """
    try:
        import yaml
    except ImportError as error:
        raise ImportError("published weights need pyyaml: pip install 'lidarsynth[metrics]'") from error
    if len(text) > LARGEST_YAML:
        raise ValueError(f"{where}: expected YAML of at most {LARGEST_YAML} bytes, found {len(text)}")
    try:
        values = yaml.safe_load(text)
    except (yaml.YAMLError, RecursionError, ValueError) as error:
        raise ValueError(f"{where}: expected YAML, found {str(error)!r:.100}") from None
    parts = [values]
    for part in parts:  # it grows on the way: aliases of aliases make a billion parts of a few lines
        parts += part.values() if isinstance(part, dict) else part if isinstance(part, list) else []
        if len(parts) > LARGEST_YAML:
            raise ValueError(f"{where}: expected YAML of at most {LARGEST_YAML} values, found more")
    return values
