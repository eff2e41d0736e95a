"""The verb `label`: a class for every point of scans that nobody has labelled."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

from lidarsynth.cli.arguments import Device, Intensity, NoSeed, Picture, Positional, Precision, SensorWord, Source, arg
from lidarsynth.cli.many import Many, work_through


def label(
    scans: Annotated[Positional[list[Path]], arg(metavar="SCAN...", help="files, folders, globs, bags, captures.")],
    out: Annotated[Path, arg(help="file to write, .ply .pcd .bin .npy .npz; a folder for several scans; or a bag.")],
    sensor: SensorWord = None,
    model: Source = "default",
    min_confidence: Annotated[
        float | None, arg(metavar="P", help="points of whose class the network is less sure get 0, unlabeled; 0 to 1.")
    ] = None,
    device: Device = "cpu",
    precision: Precision = "fp32",
    intensity: Intensity = "auto",
    picture: Picture = True,
    seed: NoSeed = 0,
    many: Annotated[Many, arg(name="")] = Many(),  # noqa: B008, frozen
) -> None:
    """A class for every point, one of SemanticKITTI's nineteen: road, building, car, person, pole ...

    Points stay, bit by bit with all their fields, and get `label` (beside a .bin a .label of raw ids), in place of any
    that they had; 0 out of the sensor's view or limits, and below --min-confidence. Learned from synthetic streets: how
    right it is on real scans, and on which classes it is not, stands in docs/simulation.md.
    """
    from lidarsynth.systems.filling import Filling
    from lidarsynth.verbs.batch import Job

    if min_confidence is not None and not 0 <= min_confidence <= 1:
        raise ValueError(f"expected --min-confidence of 0 to 1, found {min_confidence:g}")
    how = Filling(precision=precision)
    job = Job("label", model, device, how, sensor=sensor, least=min_confidence, picture=picture, labels=True)
    work_through(job, scans, out, many, intensity)
