"""The words that several verbs of the command line take, with their help."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Annotated, Literal

import tyro

arg = tyro.conf.arg
Positional = tyro.conf.Positional
# Words that a table of the library lists are plain text here: the library refuses a wrong one, and lists the others.
Count = Annotated[int, arg(aliases=["-n"], help="how many scans.")]
From = Annotated[str | None, arg(name="from")]
Source = Annotated[
    str, arg(metavar="MODEL", help="default, kitti, an official release, a model folder or an official .pth file.")
]
Filler = Annotated[
    Source, arg(help="default, kitti, an official release, a model folder, an official .pth file, or bilinear.")
]
Seed = Annotated[int, arg(help="of all randomness.")]
NoSeed = Annotated[int, arg(help="not used; every verb takes it.")]
Precision = Annotated[
    Literal["auto", "fp32", "bf16"],
    arg(help="of a cascade's network; auto is bf16 where the processor has it, which is a little less exact."),
]
Device = Annotated[str, arg(help="cpu, or cuda for a GPU.")]
Method = Annotated[
    str,
    arg(
        metavar="METHOD",
        help="conditional tells the network what is known, and errs least; sample, of a cascade, is one of many "
        "possible scans, with the grain of a recorded one; repaint and LiDARGen's posterior need no such network, "
        "and take minutes; inversion is that of GANs; LiDAR-SR has network, one pass, and monte-carlo, many.",
    ),
]
Format = Annotated[str, arg(metavar="FORMAT", help="of the files: ply, pcd, bin, npy or npz.")]
Sampler = Annotated[
    str | None,
    arg(
        metavar="SAMPLER",
        help="such as ddpm, ddim, dpmpp-2m, heun, or columns, default's best; a wrong word lists all.",
    ),
]
GenerationSteps = Annotated[
    int | None,
    arg(
        metavar="INT",
        help="of a diffusion's sampler, per scan; default 32, 1161 of langevin; default then draws by dpmpp-2m.",
    ),
]
Steps = Annotated[
    int | None,
    arg(
        metavar="INT",
        help="network steps; default 1 where conditional, 32 where repaint, 1161 where posterior, 500 where inversion.",
    ),
]
Resamples = Annotated[int | None, arg(metavar="INT", help="passes over each step of repaint; default 10.")]
Least = Annotated[
    float | None,
    arg(metavar="P", help="leave out new points less likely right than this, 0 to 1; see docs/confidence.md."),
]
Intensity = Annotated[
    Literal["auto", "unit", "byte", "uint16", "none"],
    arg(help="scale of the file's intensity: 0-1, 0-255, 0-65535, or none for a file without."),
]
Rings = Annotated[
    str | None, arg(metavar="A-B", help="of a file of several sensors, such as 32-63; all others are left out.")
]
Picture = Annotated[bool, arg(help="write a .png beside each file.")]
Labels = Annotated[bool, arg(help="SemanticKITTI's class of each point too: a field, and of .bin and .npy a .label.")]
Output = Annotated[
    Path, arg(help="file to write: .ply .pcd .bin .npy, or .npz for the image; a folder for several; or a bag.")
]
Recipe = Annotated[
    str | None,
    arg(metavar="RECIPE", help="hide first: beams:4, points:0.1, sector:90, region:5:20:-5:5, or several joined by +."),
]
SensorOut = Annotated[
    str | None, arg(name="to", metavar="SENSOR", help="of the result; for models of any sensor, such as iln, bilinear.")
]
SensorWord = Annotated[
    str | None,
    arg(
        metavar="SENSOR",
        help="a word such as vlp-16, or a .toml/.json file; if not given, a range image's own, or recognised.",
    ),
]


def fields_joined(argv: list[str]) -> list[str]:
    """A command line whose `--group.field value`, `--group.field=value` and every `--set` stand behind one `--set`."""
    rest, found, of_set = [], [], False
    words = iter(argv)
    for word in words:
        path, equals, value = word.partition("=")
        if path == "--set":
            found += [value] if equals else []
        elif re.fullmatch(r"--[a-z_]+\.[a-z0-9_-]+", path) and (equals or (value := next(words, None)) is not None):
            found.append(f"{path[2:].replace('-', '_')}={value}")
        elif of_set and not word.startswith("-"):
            found.append(word)
            continue
        else:
            rest.append(word)  # a field without a value too: let the parser complain
        of_set = path == "--set" and not equals
    return [*rest, "--set", *found] if found else rest
