"""The verb `sensor`: a sensor learned from its own scans."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

from lidarsynth.cli.arguments import Intensity, NoSeed, Picture, Positional, Rings, arg
from lidarsynth.cli.scan_files import may_draw
from lidarsynth.cli.terminal import say, warn
from lidarsynth.lidar.plural import plural, was


def sensor(
    scans: Annotated[
        Positional[list[Path]],
        arg(
            metavar="SCAN...",
            help="files, folders, globs, bags, captures; or the metadata .json of an Ouster.",
        ),
    ],
    out: Annotated[Path, arg(help=".toml to write, which every --sensor takes.")] = Path("sensor.toml"),
    topic: Annotated[
        str | None, arg(metavar="NAME", help="of a bag, or ADDRESS:PORT of a sensor in a capture.")
    ] = None,
    metadata: Annotated[
        Path | None, arg(metavar="FILE", help="JSON of an Ouster: it tells all beams; or CSV of a Hesai's capture.")
    ] = None,
    rings: Rings = None,
    transform: Annotated[
        str | None, arg(metavar="T", help="brings points into the sensor's frame, as of complete; later verbs take it.")
    ] = None,
    axes: Annotated[str, arg(metavar="XYZ", help="where x, y, z of the files point, as of complete.")] = "flu",
    seed: NoSeed = 0,
    intensity: Intensity = "none",
    picture: Picture = True,
) -> None:
    """Learn a sensor from its scans: beams, columns, limits, mount, tilt, and what its carrier blocks."""
    from lidarsynth.pictures.learned import learned_figure
    from lidarsynth.pictures.render import save_png
    from lidarsynth.verbs.inputs import Reading, inputs_of
    from lidarsynth.verbs.learned_sensor import doubts, from_metadata, learn, sensor_toml, summary, write_toml
    from lidarsynth.verbs.output_files import check_place
    from lidarsynth.verbs.placement import parse_rings, read_transform

    if out.suffix != ".toml":
        raise ValueError(f"{out}: expected a name that ends in .toml, found {out.name[-20:]!r}")
    check_place(out)
    told = scans[0] if metadata is None and len(scans) == 1 else metadata
    if told is not None and (known := from_metadata(told, out.stem)) is not None:
        write_toml(out, sensor_toml(known, [f"from the metadata {told.name}"]))
        say(f"wrote {out}: {plural(known.height, 'beam')}, {known.width} columns")
        return
    broken: list[str] = []
    moved: list[str] = []
    how = Reading(intensity, topic, metadata, read_transform(transform, None, axes), rings=parse_rings(rings))
    inputs = inputs_of(scans, how)
    for line in inputs.words:
        warn(line)
    learned = learn(inputs, out.stem, broken, moved)
    if broken:
        warn(f"{len(broken)} that could not be read {was(len(broken))} left out, the first: {broken[0]}")
    if moved:
        warn(moved[0])
    write_toml(out, sensor_toml(learned.sensor, [*summary(learned).splitlines(), *doubts(learned)]))
    say(summary(learned))
    for line in doubts(learned):
        warn(line)
    drawn = picture and may_draw(out.with_suffix(".png"))
    say(f"wrote {out}" + (f" and {save_png(out.with_suffix('.png'), learned_figure(learned))}" if drawn else ""))
