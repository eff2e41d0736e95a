"""Settings, records and indexes: small files of words, read with a bound, whatever the name leads to.

A pipe would wait for ever, a device never ends, a sparse file of 64 GiB fills the memory, and a key of 30,000 dots
keeps a TOML reader busy for minutes: each is refused in one line.
"""

from __future__ import annotations

import json
import re
import stat
import sys
from pathlib import Path
from typing import Any

if sys.version_info >= (3, 11):
    import tomllib
else:
    import tomli as tomllib  # type: ignore[import-not-found]

LARGEST = 1 << 20  # bytes of a file of settings
LARGEST_INDEX = 1 << 30  # of the index of a cache, which has a line per scan
LARGEST_WEIGHTS = 1 << 36
PIECE = 1 << 20
DOTTED = re.compile(
    r"""(?<![\w"'-])(?:[\w"'-]+[ \t]*\.[ \t]*){16}"""
)  # begins where a word does, so that it stays linear


def check_regular(path: str | Path, most: int = 1 << 62) -> None:
    """Raises ValueError unless `path` is a regular file of at most `most` bytes; OSError where there is none."""
    status = Path(path).stat()
    if not stat.S_ISREG(status.st_mode):
        what = "a folder" if stat.S_ISDIR(status.st_mode) else "a device or pipe"
        raise ValueError(f"{path}: expected a file, found {what}")
    if status.st_size > most:
        raise ValueError(f"{path}: expected at most {most} bytes, found {status.st_size}")


def read_text(path: str | Path, most: int = LARGEST) -> str:
    """The text of a regular file of at most `most` bytes of UTF-8. Raises ValueError; OSError where it has no file."""
    check_regular(path, most)
    content, room = bytearray(), most + 1  # it may have grown
    with Path(path).open("rb") as file:  # by pieces: one read of 1 GiB asks for as much memory, however short the file
        while piece := file.read(min(PIECE, room - len(content))):
            content += piece
    if len(content) > most:
        raise ValueError(f"{path}: expected at most {most} bytes, found more")
    try:
        return content.decode("utf-8-sig")  # editors of Windows begin files with a mark
    except UnicodeDecodeError as error:
        raise ValueError(f"{path}: expected text in UTF-8, found {error.reason} at byte {error.start}") from None


def read_toml(path: str | Path, most: int = LARGEST) -> dict[str, Any]:
    """The table of a TOML file. Raises ValueError; OSError where it has no file."""
    text = read_text(path, most)
    if found := DOTTED.search(text):
        raise ValueError(f"{path}: expected keys of a few words, found {found[0]:.30}...")
    try:
        return tomllib.loads(text)
    except (ValueError, RecursionError) as error:  # tomllib's own is a ValueError
        raise ValueError(f"{path}: expected TOML, found {error!s:.120}") from None


def read_json(path: str | Path, most: int = LARGEST) -> Any:
    """What a JSON file holds. Raises ValueError; OSError where it has no file."""
    text = read_text(path, most)
    try:
        return json.loads(text)
    except (ValueError, RecursionError) as error:
        raise ValueError(f"{path}: expected JSON, found {error!s:.120}") from None
