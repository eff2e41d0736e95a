"""Argoverse 2 sweeps: `.feather` tables through pyarrow (the extra `data`)."""

from __future__ import annotations

from io import BytesIO

from lidarsynth.files.fields import MAX_POINTS, Fields, FileError, check_names


def read_feather(data: bytes) -> Fields:
    """The numeric columns under their own names: x y z (float16, metres, vehicle frame), intensity 0-255, laser_number
    0-63 (two stacked VLP-32C), offset_ns; NaN where a number lacks. Raises FileError for anything pyarrow cannot
    read."""
    try:
        import pyarrow
        from pyarrow import ipc
    except ImportError:
        raise FileError("expected pyarrow to read .feather (pip install 'lidarsynth[data]'), found none") from None
    if data[:6] != b"ARROW1":
        raise FileError(f"expected a feather table (version 2), found {data[:12]!r}")
    try:
        table = ipc.open_file(BytesIO(data)).read_all()
        table.validate()
        if table.num_rows > MAX_POINTS:
            raise FileError(f"expected at most {MAX_POINTS} points of one turn, found {table.num_rows}")
        check_names(table.column_names)
        arrays = {name: table[name].to_numpy() for name in table.column_names}  # numbers that lack are NaN
    except (pyarrow.ArrowException, ValueError, OSError, MemoryError) as error:
        if isinstance(error, FileError):
            raise
        raise FileError(f"expected a feather table, found: {(str(error).splitlines() or [''])[0][:120]}") from None
    return {name: array for name, array in arrays.items() if array.dtype.kind in "biuf"}
