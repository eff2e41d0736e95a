"""Packets as Hesai's sensors send them, made from what their lasers measured: the makers' layouts, said once more."""

from __future__ import annotations

import struct
from collections.abc import Sequence

import numpy as np
import pytest

from lidarsynth.cli.main import main

# What is sent before the blocks and before each of them, blocks, lasers, bytes after a reflectivity, bytes at the end.
HEADS: dict[str, tuple[bytes, bytes, int, int, int, int]] = {
    "Pandar40P": (b"", b"\xff\xee", 10, 40, 0, 22),
    "Pandar64": (b"\xee\xff\x40\x06\x00\x04\x00\x00", b"", 6, 64, 0, 22),
    "PandarXT-32": (b"\xee\xff\x06\x01\x00\x00\x20\x08\x00\x04\x01\x01", b"", 8, 32, 1, 24),
    "PandarXT-16": (b"\xee\xff\x06\x01\x00\x00\x10\x08\x00\x04\x01\x01", b"", 8, 16, 1, 24),
    "XT32M": (b"\xee\xff\x06\x01\x00\x00\x20\x06\x00\x04\x01\x01", b"", 6, 32, 1, 24),
    "PandarQT64": (b"\xee\xff\x03\x01\x00\x00\x40\x04\x00\x04\x01\x01", b"", 4, 64, 1, 24),
}


def packet(
    model: str, azimuths: Sequence[int], distance: np.ndarray, light: np.ndarray, number: int | None = 0
) -> bytes:
    """One packet of blocks at azimuths (0.01 degrees), distances (steps of 4 mm) and reflectivities (blocks, lasers);
    its `number` at the end, or None for a sensor that sends none."""
    head, flag, blocks, lasers, spare, tail = HEADS[model]
    assert distance.shape == light.shape == (blocks, lasers) and len(azimuths) == blocks
    body = b"".join(
        flag + struct.pack("<H", azimuth)
        + b"".join(struct.pack("<HB", int(d), int(r)) + b"\x5a" * spare for d, r in zip(*both, strict=True))
        for azimuth, *both in zip(azimuths, distance, light, strict=True)
    )  # fmt: skip
    return head + body + bytes(range(tail)) + (b"" if number is None else struct.pack("<I", number))


def stream(
    model: str, azimuths: np.ndarray, distance: np.ndarray, light: np.ndarray | None = None, number: int | None = 0
) -> list[bytes]:
    """The packets, as many as are full, of blocks at azimuths (blocks,), of distances (blocks, lasers)."""
    _, _, blocks, _, _, _ = HEADS[model]
    light = distance % 251 if light is None else light
    return [
        packet(model, [int(a) for a in azimuths[i : i + blocks]], distance[i : i + blocks], light[i : i + blocks],
               None if number is None else number + i)
        for i in range(0, len(azimuths) - blocks + 1, blocks)
    ]  # fmt: skip


def angles_csv(elevations: Sequence[float], azimuths: Sequence[float], first: str = "Laser id") -> str:
    """An angle correction file."""
    rows = [f"{i},{e},{a}" for i, (e, a) in enumerate(zip(elevations, azimuths, strict=True), 1)]
    return "\n".join([f"{first},Elevation,Azimuth", *rows, ""])


def asked_for_angles(words: list[str], capsys: pytest.CaptureFixture[str]) -> str:
    """The one line by which a verb asks for the angles of a Pandar64."""
    with pytest.raises(SystemExit, match="2"):
        main(words)
    said = capsys.readouterr().err
    assert said.count("\n") == 1
    assert "expected --metadata ANGLES.csv, the angle correction file of the Pandar64" in said
    return said
