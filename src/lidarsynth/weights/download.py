"""Releases are downloaded once into the user's cache and continue where they were interrupted."""

from __future__ import annotations

import hashlib
import http.client
import os
import re
import tempfile
import urllib.error
import urllib.request
from collections.abc import Callable, Iterator
from http import HTTPStatus
from pathlib import Path
from typing import BinaryIO

from platformdirs import user_cache_path

from lidarsynth.lidar.small_file import read_text

SUMS = "SHA256SUMS"  # beside the files: lines `hash  name`, as sha256sum writes them, that a user or a team trusts
OnBytes = Callable[[int, "int | None"], object]  # called with (bytes so far, bytes in all or None if not known)


def cache_folder() -> Path:
    """Where releases are kept: LIDARSYNTH_CACHE, or ~/.cache/lidarsynth if it is there, or the system's own place."""
    if chosen := os.environ.get("LIDARSYNTH_CACHE"):
        return Path(chosen)
    try:
        earlier = Path.home() / ".cache" / "lidarsynth"  # of version 0.1.0 on every system
    except RuntimeError:  # neither HOME nor a passwd entry, as in some containers
        return Path(tempfile.gettempdir()) / "lidarsynth-cache"
    return earlier if earlier.is_dir() else user_cache_path("lidarsynth", appauthor=False)


def download(url: str, path: str | Path) -> Iterator[tuple[int, int | None]]:
    """Fetch `url` into `path`, yielding (bytes so far, bytes in all or None if not told); nothing if it is there.

    The bytes gather in `<path>.part`, which moves into place when it is complete; after an interruption, the next call
    continues there, if the server still has the same file: `<path>.part.origin` keeps its address and its tag.
    A file that the folder's SHA256SUMS names must have that hash, also one that is there already. No publisher of the
    files that we fetch has told a hash, so we bring none.
    Raises ValueError that says where to put the file by hand, or which hash was found.
    """
    path = Path(path)
    part = path.with_name(path.name + ".part")
    if path.is_file():
        _check_sum(path, path)
        return
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        part.touch()
        # Written in place, not appended: two processes that fetch the same file write the same bytes.
        origin = path.with_name(path.name + ".part.origin")
        with part.open("r+b") as file:
            yield from _receive(url, file, origin)
        _check_sum(part, path)
        os.replace(part, path)
        origin.unlink(missing_ok=True)
    except (OSError, http.client.HTTPException) as error:
        if path.is_file():  # another process was faster
            return
        if part.is_file() and not part.stat().st_size:
            part.unlink(missing_ok=True)
        place = f"without a network, put the file at {path}"
        if isinstance(error, OSError) and error.filename and not isinstance(error, urllib.error.URLError):  # our files
            place += "; LIDARSYNTH_CACHE may name another folder for it"
        raise ValueError(f"{url}: expected a download, found {_reason(error)}; {place}") from None


def _check_sum(content: Path, path: Path) -> None:
    """Raises ValueError unless a file that the SHA256SUMS beside `path` names has the hash that stands there."""
    sums = path.with_name(SUMS)
    lines = [line.split() for line in read_text(sums).splitlines()] if sums.is_file() else []
    known = {words[1].lstrip("*"): words[0].lower() for words in lines if len(words) == 2}
    if (expected := known.get(path.name)) is None:
        return
    digest = hashlib.sha256()
    with content.open("rb") as file:
        while piece := file.read(1 << 20):
            digest.update(piece)
    if (found := digest.hexdigest()) != expected:
        raise ValueError(f"{content}: expected the SHA-256 {expected} of {sums}, found {found}; delete the file to "
                         "download it again")  # fmt: skip


def _receive(url: str, file: BinaryIO, origin: Path) -> Iterator[tuple[int, int | None]]:
    """Continue `file` to the end of `url`; from the start where it is not of that file, or the server cannot."""
    told = origin.read_text(encoding="utf-8").splitlines() if origin.is_file() else []
    tag = told[1] if len(told) == 2 and told[0] == url else ""
    # The last byte is asked for again, so that a complete file is answered like any other.
    start = max(file.seek(0, os.SEEK_END) - 1, 0) if told[:1] == [url] else 0
    with _reply(url, start, tag) as reply:
        done, total = _extent(reply)
        now = reply.headers["ETag"] or reply.headers["Last-Modified"] or ""
        if done and tag and now and now != tag:
            raise ConnectionError("another file than the one that was begun; delete the .part file")
        origin.write_text(f"{url}\n{now}\n", encoding="utf-8")
        file.seek(done)
        yield done, total
        while chunk := reply.read(1 << 20):
            file.write(chunk)
            done += len(chunk)
            yield done, total
    if total is not None and done != total:
        raise ConnectionError(f"only {done} of {total} bytes")
    file.truncate(done)  # the rest, if any, is of an older and longer file


def _reply(url: str, start: int, tag: str) -> http.client.HTTPResponse:
    headers = {"Range": f"bytes={start}-"}
    if tag and not tag.startswith("W/"):  # a weak tag is not allowed here
        headers["If-Range"] = tag  # where the file changed, all of it comes
    try:
        return urllib.request.urlopen(urllib.request.Request(url, headers=headers), timeout=30)
    except urllib.error.HTTPError as error:
        if error.code != HTTPStatus.REQUESTED_RANGE_NOT_SATISFIABLE:
            raise
        error.close()
        return urllib.request.urlopen(url, timeout=30)


def _extent(reply: http.client.HTTPResponse) -> tuple[int, int | None]:
    """First byte of a reply, and bytes of the whole file or None if not told."""
    length = reply.headers["Content-Length"]
    if reply.status != HTTPStatus.PARTIAL_CONTENT:
        return 0, None if length is None else int(length)
    told = reply.headers["Content-Range"] or ""  # bytes FIRST-LAST/TOTAL
    match = re.fullmatch(r"bytes (\d+)-\d+/(\d+|\*)", told)
    if match is None:
        raise ConnectionError(f"an answer with Content-Range {told!r}")
    return int(match[1]), None if match[2] == "*" else int(match[2])


def _reason(error: Exception) -> str:
    if isinstance(error, urllib.error.HTTPError):
        error.close()
    elif isinstance(error, urllib.error.URLError):
        return str(error.reason)
    return str(error)
