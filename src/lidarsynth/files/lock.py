"""One writer per folder: a lock that dies with its process, whatever kills it.

flock(2) on a file `.lock`: the kernel lets go when the process ends, also after kill -9 or a power cut, so nothing is
ever left to clean up. It holds on local file systems, and on NFS from Linux 2.6.12 and SMB from Linux 5.5 between
machines where the server keeps locks (NFS: not mounted `nolock`). Where the file system or the system knows no locks at
all, work goes on without one.
"""

from __future__ import annotations

import errno
import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

LOCK = ".lock"
UNKNOWN = (errno.ENOLCK, errno.ENOSYS, errno.EOPNOTSUPP, errno.EINVAL)  # of file systems that have no locks


@contextmanager
def only_writer(folder: Path, work: str) -> Iterator[None]:
    """Hold the folder, which is made if it is not there, for as long as the context lasts.

    work  in words, such as "training", for the error
    Raises ValueError where another process holds it.
    """
    try:
        import fcntl
    except ImportError:  # Windows
        yield
        return
    if folder.exists() and not folder.is_dir():
        raise ValueError(f"{folder}: expected a folder to write to, found a file")
    folder.mkdir(parents=True, exist_ok=True)
    path, held = folder / LOCK, False
    while not held:
        with path.open("ab") as file:
            try:
                fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError:
                raise ValueError(f"{folder}: expected a folder that nobody else writes to, found another {work} at "
                                 "work in it; name another folder, or wait") from None  # fmt: skip
            except OSError as error:
                if error.errno not in UNKNOWN:
                    raise
            # who held it before may have taken the file away after we opened it: then it is another one now
            held = _inode(path) == os.fstat(file.fileno()).st_ino
            if held:
                try:
                    yield
                finally:
                    path.unlink(missing_ok=True)


def _inode(path: Path) -> int | None:
    try:
        return path.stat().st_ino
    except FileNotFoundError:
        return None
