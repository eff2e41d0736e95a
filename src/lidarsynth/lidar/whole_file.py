"""A file appears whole or not at all: it is written beside its place under another name, then renamed.

What a killed process leaves are hidden files `.NAME.TOKEN.part`, which no reader looks at and `sweep` removes.
"""

from __future__ import annotations

import os
import secrets
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from glob import escape
from pathlib import Path


@contextmanager
def whole_file(path: str | Path, durable: bool = False) -> Iterator[Path]:
    """Where to write the file `path`: a name in the same folder that is moved to `path` when the block ends well.

    The file gets the rights that the user's umask leaves, whoever wrote it.
    durable  on the disk before it is moved, so that it survives a power cut from then on
    Raises OSError that names `path`, which is left as it was, as it is by any other error of the block.
    """
    path = Path(path)
    scratch = path.with_name(f".{path.stem[:64]}.{secrets.token_hex(8)}.part")  # a pid is not alone on a shared disk
    try:
        yield scratch
        if durable:
            with scratch.open("r+b") as file:  # Windows puts on the disk what can be written only
                os.fsync(file.fileno())
        os.replace(scratch, path)
    except OSError as error:
        raise OSError(error.errno, error.strerror or str(error), str(path)) from None
    finally:
        with suppress(OSError):
            scratch.unlink(missing_ok=True)


def write_whole(path: str | Path, content: str | bytes | memoryview) -> None:
    """Write text, as UTF-8, or bytes with `whole_file`. Raises OSError."""
    with whole_file(path) as scratch:
        scratch.write_bytes(content.encode() if isinstance(content, str) else content)


TOKEN = "[0-9a-f]" * 16  # what `whole_file` puts into a name, as a pattern


def unfinished(path: str | Path) -> list[Path]:
    """What killed processes, or one at work, left beside a file that they wrote with `whole_file`."""
    path = Path(path)
    return sorted(path.parent.glob(f".{escape(path.stem[:64])}.{TOKEN}.part"))


def sweep(folder: str | Path, deep: bool = False, token: str = "*") -> None:
    """Remove what killed processes left unfinished in a folder, and below it if `deep`; nobody may be writing there.

    token  pattern of the last part of the names; TOKEN where others' hidden files may lie too
    """
    for stale in Path(folder).glob(f"{'**/' if deep else ''}.*{'' if token == '*' else '.' + token}.part"):
        with suppress(OSError):
            stale.unlink()
