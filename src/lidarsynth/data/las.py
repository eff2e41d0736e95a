"""ASPRS `.las` and `.laz` files through laspy (the extra `data`)."""

from __future__ import annotations

from io import BytesIO

import numpy as np

from lidarsynth.data.fields import MAX_POINTS, NAMES, Fields, FileError


def read_las(data: bytes) -> Fields:
    """x, y, z in metres, intensity, and every further dimension under one of the usual names.

    Raises FileError for anything laspy cannot read, and ImportError-free: a missing laspy is a FileError that names the
    extra.
    """
    try:
        import laspy
    except ImportError:
        raise FileError("expected laspy to read .las/.laz (pip install 'lidarsynth[data]'), found none") from None
    if data[:4] != b"LASF":
        raise FileError(f"expected a file that starts with LASF, found {data[:12]!r}")
    try:
        with laspy.open(BytesIO(data)) as reader:
            count, size = reader.header.point_count, reader.header.point_format.size
            packed = reader.header.are_points_compressed
            if count > MAX_POINTS or (not packed and count * size > len(data)):
                raise FileError(f"expected {count} points of {size} bytes in the file, found {len(data)} bytes")
            points = reader.read()
            names = set(points.point_format.dimension_names) & {n for usual in NAMES.values() for n in usual}
            return {axis: np.asarray(points[axis]) for axis in "xyz"} | {n: np.asarray(points[n]) for n in names}
    except FileError:
        raise
    except BaseException as error:  # laspy and its Rust decoder raise a dozen types on broken files
        if isinstance(error, (KeyboardInterrupt, SystemExit)):
            raise
        reason = (str(error).splitlines() or [""])[0][:120] or type(error).__name__
        raise FileError(f"expected a LAS file laspy can read, found: {reason}") from None
