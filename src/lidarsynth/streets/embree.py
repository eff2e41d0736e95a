"""Embree's own C interface, of the library that the wheel of embreex brings: sixteen rays at once.

embreex casts rays one by one and copies a scene triangle by triangle. Neighbouring beams meet nearly the same parts of
the tree, so that packets of sixteen are cast in half the time (Wald et al., 2014); the scene reads our own arrays.
Names and numbers of embree.github.io/api.html, version 4.
"""

from __future__ import annotations

import ctypes
import threading
from collections import deque
from functools import lru_cache
from itertools import repeat
from pathlib import Path

import numpy as np

PACKET = 16  # rays
BLOCK = 512  # packets filled at a time: what lies in the processor's cache
# 64-byte rows of RTCRayHit16: origin 0-2, nearest 3, direction 4-6, time 7, farthest 8, mask 9, id 10, flags 11,
# normal 12-14, u 15, v 16, triangle 17, geometry 18, instance 19 and 20.
NEAREST, DIRECTION, TIME, FARTHEST, MASK, FLAGS, TRIANGLE, GEOMETRY, ROWS = 3, 4, 7, 8, 9, 11, 17, 18, 21
NONE = np.uint32(0xFFFFFFFF)
TRIANGLES, INDICES, VERTICES, THREE_INTEGERS, THREE_FLOATS = 0, 0, 1, 0x5003, 0x9003
COHERENT = 1 << 16


class _Arguments(ctypes.Structure):
    """RTCIntersectArguments: rays of a packet go nearly the same way."""

    _fields_ = (
        ("flags", ctypes.c_int),
        ("features", ctypes.c_uint),
        *((name, ctypes.c_void_p) for name in ("context", "filter", "intersect")),
        ("width", ctypes.c_float),
    )


@lru_cache(maxsize=1)
def library() -> ctypes.PyDLL | None:
    """Embree 4 as embreex brought it, None where its wheel has it elsewhere. Raises ImportError without embreex."""
    import embreex
    from embreex import rtcore_scene  # noqa: F401 - loads what Embree needs

    package = Path(embreex.__file__).parent
    for folder in (package.parent / "embreex.libs", package / ".dylibs"):
        for path in sorted(folder.glob("*embree4*")):
            return _declared(ctypes.PyDLL(str(path)))
    return None


def _declared(embree: ctypes.PyDLL) -> ctypes.PyDLL:
    handle, number, size = ctypes.c_void_p, ctypes.c_int, ctypes.c_size_t
    buffer = (handle, number, ctypes.c_uint, number, handle, size, size, size)
    for name, answer, arguments in (
        ("NewDevice", handle, (ctypes.c_char_p,)),
        ("NewScene", handle, (handle,)),
        ("NewGeometry", handle, (handle, number)),
        ("SetSharedGeometryBuffer", None, buffer),
        ("CommitGeometry", None, (handle,)),
        ("AttachGeometry", ctypes.c_uint, (handle, handle)),
        ("ReleaseGeometry", None, (handle,)),
        ("CommitScene", None, (handle,)),
        ("ReleaseScene", None, (handle,)),
    ):
        function = getattr(embree, f"rtc{name}")
        function.restype, function.argtypes = answer, arguments
    embree.rtcIntersect16.restype = None  # is given handles: a list of numbers would have each converted
    return embree


@lru_cache(maxsize=1)
def _device() -> int:
    embree = library()
    assert embree is not None
    device = embree.rtcNewDevice(b"threads=1")  # processes share the work, not threads
    if not device:
        raise RuntimeError("expected Embree to start, it did not")
    return device


class PacketScene:
    """A scene of T triangles, corners (T, 3, 3) float32 metres; `library()` must have found one."""

    def __init__(self, corners: np.ndarray):
        embree = library()
        assert embree is not None
        self._embree, count = embree, len(corners)
        self._vertices = np.zeros(corners.size + 1, np.float32)  # Embree may read four floats at the last vertex
        self._vertices[:-1] = corners.reshape(-1)
        self._indices = np.arange(3 * count, dtype=np.uint32)
        self._scene = embree.rtcNewScene(_device())
        mesh = embree.rtcNewGeometry(_device(), TRIANGLES)
        for kind, layout, values, rows in (
            (VERTICES, THREE_FLOATS, self._vertices, 3 * count),
            (INDICES, THREE_INTEGERS, self._indices, count),
        ):
            embree.rtcSetSharedGeometryBuffer(mesh, kind, 0, layout, values.ctypes.data, 0, 12, rows)
        embree.rtcCommitGeometry(mesh)
        embree.rtcAttachGeometry(self._scene, mesh)
        embree.rtcReleaseGeometry(mesh)
        embree.rtcCommitScene(self._scene)

    def __del__(self):
        if scene := getattr(self, "_scene", None):
            self._embree.rtcReleaseScene(scene)

    def faces(self, origins: np.ndarray, rays: np.ndarray) -> np.ndarray:
        """(N,) int32: the triangle that each ray first meets, -1 for none. origins, rays (N, 3) float32.

        Faster where x, y and z lie apart in memory: views (3, N).T.
        """
        count, found = len(rays), np.empty(len(rays), np.int32)
        chosen, rest = _aligned(1)[0].view(np.int32), count % PACKET
        chosen[0], chosen[1] = -1, np.where(np.arange(PACKET) < rest, -1, 0)  # all rays, and those of the last packet
        arguments, cast = _Arguments(COHERENT, NONE, None, None, None, 0), self._embree.rtcIntersect16
        every, last = (_at(row.ctypes.data) for row in chosen[:2])
        scene, how = _at(self._scene), _at(ctypes.addressof(arguments))
        for start in range(0, count, BLOCK * PACKET):
            part = slice(start, start + BLOCK * PACKET)
            mine = found[part]
            full = len(mine) // PACKET
            packets = SCRATCH.packets[: -(-len(mine) // PACKET)]
            _fill(packets, origins[part], rays[part])
            deque(map(cast, repeat(every), repeat(scene), SCRATCH.places[:full], repeat(how)), maxlen=0)
            if full < len(packets):
                cast(last, scene, SCRATCH.places[full], how)
            faces = packets[:, TRIANGLE].view(np.int32)
            mine[: full * PACKET].reshape(full, PACKET)[:] = faces[:full]
            mine[full * PACKET :] = faces[full:].reshape(-1)[: len(mine) - full * PACKET]
        return found


def _at(address: int) -> object:
    """A pointer as `ctypes` passes it on without making it anew for each call."""
    return ctypes.byref(ctypes.c_char.from_address(address))


def _fill(packets: np.ndarray, origins: np.ndarray, rays: np.ndarray) -> None:
    """Writes (N, 3) rays into `packets` (P, ROWS, PACKET), as many as there is place for or fewer."""
    full, rest = divmod(len(rays), PACKET)
    for first, values in ((0, origins.T), (DIRECTION, rays.T)):
        rows = packets[:, first : first + 3]
        rows[:full] = values[:, : full * PACKET].reshape(3, full, PACKET).transpose(1, 0, 2)
        if rest:
            rows[full, :, :rest], rows[full, :, rest:] = values[:, full * PACKET :], 0
    packets[:, FARTHEST], packets.view(np.uint32)[:, TRIANGLE : GEOMETRY + 1] = np.inf, NONE


def _aligned(count: int) -> np.ndarray:
    """(count, ROWS, PACKET) float32 that begin at a multiple of 64 bytes, as Embree wants its packets."""
    size = count * ROWS * PACKET
    memory = np.empty(size + PACKET, np.float32)
    first = (-memory.ctypes.data % 64) // memory.itemsize
    return memory[first : first + size].reshape(count, ROWS, PACKET)


class _Scratch(threading.local):
    """BLOCK packets and where each lies, of each thread, with what casting leaves as it is already written."""

    def __init__(self):
        self.packets = _aligned(BLOCK)
        first, step = self.packets.ctypes.data, self.packets.strides[0]
        self.places = [_at(first + step * packet) for packet in range(BLOCK)]
        self.packets[:, NEAREST], self.packets[:, TIME] = 0, 0
        words = self.packets.view(np.uint32)
        words[:, MASK : FLAGS + 1], words[:, FLAGS], words[:, TRIANGLE:] = NONE, 0, NONE


SCRATCH = _Scratch()
