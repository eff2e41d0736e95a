"""The verb `view`: scans in the browser."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from lidarsynth.cli.arguments import Intensity, NoSeed, Positional, Rings, arg
from lidarsynth.cli.terminal import at_least, say, warn
from lidarsynth.lidar.plural import was

if TYPE_CHECKING:
    from lidarsynth.viewer.server import Show

ENDINGS = (".html", ".htm")


def view(
    scans: Annotated[Positional[list[Path]], arg(metavar="SCAN...", help="files, folders, globs, bags, captures.")],
    other: Annotated[
        Path | None, arg(name="with", metavar="SCAN", help="to switch to: the truth, or the scan before.")
    ] = None,
    out: Annotated[
        Path | None, arg(metavar="HTML", help="write one file that holds page and scans, instead of a server.")
    ] = None,
    port: Annotated[int, arg(help="of 127.0.0.1; 0 = any that is free.")] = 0,
    browser: Annotated[bool, arg(help="open the page, where there is a screen.")] = True,
    seed: NoSeed = 0,
    intensity: Intensity = "auto",
    topic: Annotated[
        str | None,
        arg(metavar="NAME", help="of a bag, or ADDRESS:PORT of a sensor in a capture; the only one if not given."),
    ] = None,
    metadata: Annotated[Path | None, arg(metavar="FILE", help="JSON of an Ouster's, CSV of a Hesai's packets.")] = None,
    transform: Annotated[
        str | None,
        arg(metavar="T", help="brings points into the sensor's frame: x:y:z:roll:pitch:yaw, or a file of 4 x 4."),
    ] = None,
    axes: Annotated[
        str, arg(metavar="XYZ", help="where x, y, z of the files point: CARLA has fru, AirSim frd.")
    ] = "flu",
    mount: Annotated[float | None, arg(metavar="M", help="metres of the sensor above the points' z = 0.")] = None,
    rings: Rings = None,
) -> None:
    """Scans in the browser, from a page on this machine alone; or, with --out, as one file to send."""
    from lidarsynth.verbs.inputs import Reading
    from lidarsynth.verbs.output_files import check_place
    from lidarsynth.verbs.placement import parse_rings, read_transform
    from lidarsynth.viewer.page import write_page
    from lidarsynth.viewer.pairs import compared, entries
    from lidarsynth.viewer.server import Show

    at_least(0, {"port": port})
    if out is not None and out.suffix.lower() not in ENDINGS:
        raise ValueError(f"{out}: expected a name that ends in .html, found {out.name[-20:]!r}")
    if out is not None:
        check_place(out)
    how = Reading(intensity, topic, metadata, read_transform(transform, mount, axes), rings=parse_rings(rings))
    series = compared(scans, other, how)
    for line in dict.fromkeys(line for one in series.values() for line in one.cut):
        warn(line)
    title = next(iter(series))
    if out is None:
        return _serve(Show(title, series), port, browser)
    broken: list[str] = []
    size = write_page(out, title, entries(series, broken))
    if broken:
        warn(f"{len(broken)} that could not be read {was(len(broken))} left out, the first: {broken[0]}")
    say(f"wrote {out}, {size / 1e6:.1f} MB: open it in any browser, without a network")


def _serve(show: Show, port: int, browser: bool) -> None:
    """The page until Ctrl-C."""
    from lidarsynth.viewer.server import address, serve

    with serve(show, port) as server:
        say(f"{address(server, show)}\nOnly this machine reaches it, and only by this address. Ctrl-C ends it.")
        if browser:
            _open(address(server, show))
        try:
            server.serve_forever()
        except KeyboardInterrupt:
            say("")


def _open(where: str) -> None:
    """In the browser of the desktop; a terminal's own browser would only get in the way."""
    import os
    import sys
    import webbrowser

    if sys.platform in ("darwin", "win32") or os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY"):
        webbrowser.open(where)
