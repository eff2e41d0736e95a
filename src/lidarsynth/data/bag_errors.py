"""What the libraries of bags raise, as one line."""

from __future__ import annotations

import sqlite3
import struct
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from lidarsynth.files.fields import FileError

BROKEN = (  # of memory, too: a damaged length asks for more than there is
    OSError, ValueError, LookupError, EOFError, RuntimeError, AssertionError, TypeError, OverflowError, struct.error,
    MemoryError,
)  # fmt: skip


def library_errors() -> tuple[type[Exception], ...]:
    """What the libraries raise of their own."""
    import zstandard
    from mcap.exceptions import McapError
    from rosbags.rosbag1 import ReaderError as Error1
    from rosbags.rosbag2 import ReaderError as Error2
    from rosbags.serde import SerdeError
    from rosbags.typesys import TypesysError

    known = sqlite3.Error, McapError, Error1, Error2, SerdeError, TypesysError, zstandard.ZstdError
    try:
        from apsw import Error as SqlError  # with which rosbags reads databases, in others of its versions
    except ImportError:
        return known
    return (*known, SqlError)


def check_packages() -> None:
    """Raises FileError where the extra `ros` is missing."""
    try:
        import mcap
        import rosbags
    except ImportError:
        raise FileError("expected rosbags and mcap to read and write bags (pip install 'lidarsynth[ros]'), "
                        "found none") from None  # fmt: skip
    del mcap, rosbags


@contextmanager
def naming(path: Path) -> Iterator[None]:
    """Turns whatever a broken bag makes a library raise into one line that names the bag."""
    try:
        yield
    except FileError:
        raise
    except (*BROKEN, *library_errors()) as error:
        raise FileError(f"{path}: expected a bag of ROS 1 or ROS 2, or MCAP, found: {one_line(error)}") from None


def one_line(error: Exception) -> str:
    """What an error says, in one line; its kind where it says nothing."""
    return " ".join(str(error).split())[:160] or type(error).__name__
