"""One writer per folder, or several that share it: a lock that dies with its process, whatever kills it.

flock(2) on a file `.lock`: the kernel lets go when the process ends, also after kill -9 or a power cut, so nothing is
ever left to clean up. It holds on local file systems, and on NFS from Linux 2.6.12 and SMB from Linux 5.5 between
machines where the server keeps locks (NFS: not mounted `nolock`). Where the file system or the system knows no locks at
all, work goes on without one.
"""

from __future__ import annotations

import errno
import os
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

LOCK = ".lock"
TRIES, SOON = 5, 0.05  # seconds between
UNKNOWN = (errno.ENOLCK, errno.ENOSYS, errno.EOPNOTSUPP, errno.EINVAL)  # of file systems that have no locks


@contextmanager
def only_writer(folder: Path, work: str, shared: bool = False) -> Iterator[bool]:
    """Hold the folder, which is made if it is not there, with those above it, and goes again where nothing came into
    it, for as long as the context lasts; gives whether there is a lock, without which others may be there.

    work    in words, such as "training", for the error
    shared  with others that share it
    Raises ValueError where another process holds it, or, unless `shared`, any shares it, OSError of one line where it
    cannot be written to.
    """
    try:
        import fcntl
    except ImportError:  # Windows
        yield False
        return
    if not folder.is_dir() and (folder.exists() or folder.is_symlink()):
        found = "a file" if folder.exists() else "a link to nothing"
        raise ValueError(f"{folder}: expected a folder to write to, found {found}")
    path, held, locked, tries = folder / LOCK, False, True, TRIES if shared else 1
    made = [at for at in (folder, *folder.parents) if not at.exists()]
    while not held:
        with _writable(folder):
            folder.mkdir(parents=True, exist_ok=True)  # a shard that left nothing in it may have taken it away
            try:
                opened = path.open("a+b")  # NFS wants to read what is shared
            except FileNotFoundError:
                continue
        with opened as file:
            try:
                fcntl.flock(file, (fcntl.LOCK_SH if shared else fcntl.LOCK_EX) | fcntl.LOCK_NB)
            except BlockingIOError:
                tries -= 1
                if tries:  # the last of those that shared it may be about to take the file away
                    time.sleep(SOON)
                    continue
                raise ValueError(f"{folder}: expected a folder that nobody else writes to, found another {work} at "
                                 "work in it; name another folder, or wait") from None  # fmt: skip
            except OSError as error:
                if error.errno not in UNKNOWN:
                    raise
                locked = False
            # who held it before may have taken the file away after we opened it: then it is another one now
            held = _inode(path) == os.fstat(file.fileno()).st_ino
            if held:
                try:
                    yield locked
                finally:
                    with suppress(OSError):  # where others share it, the last one takes the file away
                        if locked and shared:
                            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
                        path.unlink(missing_ok=True)
                        for at in made:
                            at.rmdir()  # refused where it holds anything


@contextmanager
def _writable(folder: Path) -> Iterator[None]:
    """Names the folder, and not a file in it that nobody knows, where it cannot be made or written to."""
    try:
        yield
    except (PermissionError, NotADirectoryError, FileExistsError) as error:
        raise OSError(f"{folder}: expected a folder to write to, found: {error.strerror}") from None


def _inode(path: Path) -> int | None:
    try:
        return path.stat().st_ino
    except FileNotFoundError:
        return None
