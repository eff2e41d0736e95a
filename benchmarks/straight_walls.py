"""How much of what stands is on walls that go on straight, in generated scans and in streets.

python benchmarks/straight_walls.py --scans 64        of `default`'s scans of hdl-64e-kitti, and of held-out streets

Of 16 beams x 128 columns of each scan, as the layout is drawn: the share of the returns that are not on flat ground and
whose last 4, 6, 8, 12 columns on the ring stray by at most 1 %, and 3 %, from a line seen from above.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterable

import numpy as np
import torch

import lidarsynth as ls
from lidarsynth.lidar.scan import RangeImage
from lidarsynth.lidar.sensor import SENSORS, Sensor
from lidarsynth.networks.coarse_unet import grid_columns, grid_rays, grid_rows
from lidarsynth.networks.column_neighbours import known_grid, nearness
from lidarsynth.networks.wall_lines import fitted
from lidarsynth.streets.hdl64e import hidden
from lidarsynth.streets.reader import SyntheticStreets
from lidarsynth.systems.cascade.model import CascadeModel

LENGTHS, STRAYING, FLAT = (4, 6, 8, 12), (0.01, 0.03), 0.03  # FLAT: of the range code, on the ground
SEED = 779  # of the streets


def straight(images: Iterable[RangeImage], sensor: Sensor) -> np.ndarray:
    """(2, 4) shares: straying by at most 1 % and 3 %, of 4 to 12 columns."""
    rows, columns = grid_rows(sensor.height), grid_columns(sensor.width)
    rays = grid_rays(sensor, hidden(sensor), rows, columns)[0][None]
    at = np.ix_(rows, columns)
    metres = torch.from_numpy(np.stack([image.range[at] * image.mask[at] for image in images])).float()
    grid = known_grid(metres, torch.zeros_like(metres))
    near, stands = nearness(grid.code, grid.returned, rays), (grid.code - rays[:, 1] / 2).abs() > FLAT
    stands &= grid.returned
    shares = np.zeros((len(STRAYING), len(LENGTHS)))
    for k, length in enumerate(LENGTHS):
        last = torch.cat([near[..., 1 - length :], near], -1).unfold(-1, length, 1).flip(-1)
        off = ((fitted(last)[1] - last).abs() / last.clamp_min(1e-6)).amax(-1)
        whole = stands & (last > 0).all(-1)
        shares[:, k] = [float((whole & (off < most)).sum() / stands.sum()) for most in STRAYING]
    return shares


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scans", type=int, default=64)
    parser.add_argument("--seed", type=int, default=10, help="of the generated scans")
    args = parser.parse_args()
    sensor, model = SENSORS["hdl-64e-kitti"], ls.load("default")
    assert isinstance(model, CascadeModel)
    streets = SyntheticStreets(SEED, 1 << 40, sensor, apart=True)
    print(f"| columns | {' | '.join(map(str, LENGTHS * 2))} |")
    print("|---" * (1 + 2 * len(LENGTHS)) + "|")
    for name, images in (
        ("generated", model.into(sensor).stream(args.scans, seed=args.seed, batch_size=16)),
        ("streets", (streets.image(i) for i in range(args.scans))),
    ):
        print(f"| {name} | {' | '.join(f'{share:.1%}' for share in straight(images, sensor).ravel())} |", flush=True)


if __name__ == "__main__":
    main()
