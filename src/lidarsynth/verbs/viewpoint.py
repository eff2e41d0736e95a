"""What is said of a PCD file whose VIEWPOINT puts the sensor elsewhere than at the origin."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from lidarsynth.files.fields import FileError
from lidarsynth.files.formats import no_file
from lidarsynth.files.pcd import MAX_HEADER, viewpoint
from lidarsynth.lidar.frame import pose_of


def viewpoint_note(path: Path) -> str | None:
    """Where the sensor stood by a `.pcd` file, and what to do if its points are not in the sensor's frame, in one line;
    None of other files, and where it stood at the origin."""
    if path.suffix.lower() != ".pcd" or no_file(path) is not None:
        return None
    try:
        with path.open("rb") as file:
            place = viewpoint(file.read(MAX_HEADER))
    except (OSError, FileError):  # reading the scan says so
        return None
    if place is None:
        return None
    stood, back = (":".join(f"{v:.10g}" for v in pose_of(matrix)) for matrix in (place, np.linalg.inv(place)))
    return f"expected a VIEWPOINT at the origin, found {stood} (x:y:z:roll:pitch:yaw): points are taken for the " \
           "sensor's own, and what is written has none; if they are in the frame that it stood in, " \
           f"--transform {back}"  # fmt: skip
