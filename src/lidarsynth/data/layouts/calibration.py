"""The virtual camera of KITTI's layouts: at the sensor's origin, looking ahead, as wide as KITTI's."""

from __future__ import annotations

from functools import lru_cache

import numpy as np

FOCAL, MIDDLE = 721.5377, (609.5593, 172.854)  # pixels; KITTI's P2 of 2011_09_26
IMAGE = (1242, 375)  # columns, rows
AXES = np.array([[0.0, -1, 0, 0], [0, 0, -1, 0], [1, 0, 0, 0], [0, 0, 0, 1]])  # sensor -> camera: right, down, forward
PROJECTION = np.array([[FOCAL, 0, MIDDLE[0], 0], [0, FOCAL, MIDDLE[1], 0], [0, 0, 1, 0]])


def numbers(values: np.ndarray) -> str:
    """Row by row as KITTI's text files have them."""
    return " ".join(f"{value:.12e}" for value in np.asarray(values, float).ravel())


def odometry_calibration() -> str:
    """`calib.txt` of a sequence: P0 to P3 and Tr, sensor to camera 0, 12 numbers each."""
    lines = [f"P{k}: {numbers(PROJECTION)}" for k in range(4)]
    return "\n".join([*lines, f"Tr: {numbers(AXES[:3])}"]) + "\n"


@lru_cache(maxsize=1)
def object_calibration() -> str:
    """`calib/NNNNNN.txt` of the object benchmark; OpenPCDet reads it by line number."""
    lines = [f"P{k}: {numbers(PROJECTION)}" for k in range(4)]
    imu = np.eye(4)[:3]
    rest = (("R0_rect", np.eye(3)), ("Tr_velo_to_cam", AXES[:3]), ("Tr_imu_to_velo", imu))
    return "\n".join([*lines, *(f"{name}: {numbers(matrix)}" for name, matrix in rest)]) + "\n\n"


def camera_poses(to_world: np.ndarray) -> np.ndarray:
    """(N, 3, 4) poses of `poses.txt`, camera of scan i -> camera of the first, from sensor poses (N, 4, 4)."""
    relative = np.linalg.inv(to_world[0]) @ to_world
    return (AXES @ relative @ np.linalg.inv(AXES))[:, :3]
