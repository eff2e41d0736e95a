"""The page: one HTML text with its style, its script and its settings inside; and the file that holds scans as well."""

from __future__ import annotations

import base64
import gzip
import json
import secrets
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from lidarsynth.lidar.whole_file import write_whole
from lidarsynth.viewer.colouring import colourings, ground_height
from lidarsynth.viewer.packing import Shown, packed

STATIC = Path(__file__).parent / "static"
SCRIPTS = ("decode.js", "colours.js", "hiding.js", "camera.js", "scene.js", "splat.js", "lines.js", "strips.js",
           "legend.js", "source.js", "motion.js", "pointer.js", "screenshot.js", "app.js")  # fmt: skip
LIVE = "default-src 'none'; style-src 'nonce-{0}'; script-src 'nonce-{0}'; connect-src 'self'; img-src blob: data:"
ALONE = "default-src 'none'; style-src 'nonce-{0}'; script-src 'nonce-{0}'; img-src blob: data:"


@dataclass(frozen=True)
class Entry:
    """One stop of the slider: its name, and the scans that the switch changes between, by caption."""

    name: str
    versions: dict[str, Shown]


def settings_of(first: Shown, title: str) -> dict[str, Any]:
    """What the page must know before any scan: its title, colours fitted to the first scan, the height of the road."""
    return {"title": title, "colourings": colourings(first.scan), "ground": ground_height(first.scan)}


def page(settings: dict[str, Any], nonce: str, policy: str = LIVE, scans: str = "") -> str:
    """The page; `settings` reach the script as JSON that cannot end its element."""
    script = "\n".join((STATIC / name).read_text(encoding="utf-8") for name in SCRIPTS)
    parts = {
        "POLICY": policy.format(nonce),
        "NONCE": nonce,
        "STYLE": (STATIC / "style.css").read_text(encoding="utf-8"),
        "SCANS": scans,
        "SETTINGS": json.dumps(settings, allow_nan=False).replace("<", "\\u003c"),
        "SCRIPT": f'"use strict";\n{script}',
    }
    pieces = (
        (STATIC / "page.html").read_text(encoding="utf-8").split("%%")
    )  # text, name, text, ...: what is put in is not looked at
    return "".join(parts[piece] if place % 2 else piece for place, piece in enumerate(pieces))


def standalone(title: str, entries: Iterable[Entry]) -> str:
    """A page that needs nothing but itself: its scans are gzipped, in base64, each in an element of its own.

    Raises ValueError without any entry.
    """
    scans: list[str] = []
    index: list[dict[str, Any]] = []
    settings: dict[str, Any] = {}
    for entry in entries:
        for number, shown in enumerate(entry.versions.values()):
            settings = settings or settings_of(shown, title)
            data = base64.b64encode(gzip.compress(packed(shown), mtime=0)).decode()
            scans.append(f'<script type="text/plain" id="scan-{len(index)}-{number}">{data}</script>\n')
        index.append({"name": entry.name, "captions": list(entry.versions)})
    if not index:
        raise ValueError("expected one scan or more to show, found none")
    return page(settings | {"entries": index}, secrets.token_urlsafe(12), ALONE, "".join(scans))


def write_page(path: Path, title: str, entries: Iterable[Entry]) -> int:
    """Write a standalone page, whole or not at all; returns its bytes.

    Raises OSError in one line where it cannot be written, and what reading a scan does.
    """
    content = standalone(title, entries).encode()
    path.parent.mkdir(parents=True, exist_ok=True)
    write_whole(path, content)
    return len(content)
