"""LZF decompression (the block format of Marc Lehmann's liblzf), which `.pcd` files call `binary_compressed`."""

from __future__ import annotations

from lidarsynth.files.fields import FileError

MAX_RATIO = 264 // 3  # the longest match: 264 bytes written from 3 bytes read


def decompress(data: bytes, size: int) -> bytearray:
    """The `size` bytes packed in `data`.

    Raises FileError when the block ends early, points before its start, or holds another number of bytes; never writes
    more than a longest match past `size`.
    """
    if size > MAX_RATIO * (len(data) + 1):
        raise FileError(f"expected at most {MAX_RATIO} bytes per compressed byte, found {len(data)} for {size}")
    out = bytearray()
    try:
        _unpack(data, size, out)
    except IndexError:
        raise FileError(f"expected {size} bytes in the compressed block, found its end after {len(out)}") from None
    if len(out) != size:
        raise FileError(
            f"expected {size} bytes in the compressed block, found {len(out)}{'' if len(out) < size else '+'}"
        )
    return out


def _unpack(data: bytes, size: int, out: bytearray) -> None:
    """Control byte c < 32: c + 1 literal bytes follow. Otherwise a match: length c >> 5 (7: one more byte) + 2, at
    distance ((c & 31) << 8 | next byte) + 1 before the end."""
    at, end, written = 0, len(data), 0
    while at < end and written <= size:
        control = data[at]
        at += 1
        if control < 32:
            stop = at + control + 1
            if stop > end:
                raise IndexError
            out += data[at:stop]
            at = stop
            written += control + 1
            continue
        length = control >> 5
        if length == 7:
            length += data[at]
            at += 1
        length += 2
        start = written - ((control & 31) << 8) - data[at] - 1
        at += 1
        if start < 0:
            raise FileError(f"expected matches inside the compressed block, found one {-start} bytes before its start")
        if start + length <= written:
            out += out[start : start + length]
        else:  # the match overlaps what it writes: the tail repeats
            tail = out[start:]
            out += (tail * (length // len(tail) + 1))[:length]
        written += length
