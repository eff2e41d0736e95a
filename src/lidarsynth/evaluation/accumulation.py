"""Images -> statistics of a protocol: which networks are here, which images count, and going on after a stop."""

from __future__ import annotations

import hashlib
import random
import time
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal, TypeAlias

from torch import nn

from lidarsynth.data.cache import sha256
from lidarsynth.data.kitti360 import SPLITS
from lidarsynth.evaluation.features import gated
from lidarsynth.evaluation.image_sets import ImageSet
from lidarsynth.evaluation.protocol import EvaluationProtocol, Network
from lidarsynth.evaluation.statistics import Statistics, load_statistics, save_statistics
from lidarsynth.experiment.record import WEIGHTS
from lidarsynth.lidar.scan import RangeImage
from lidarsynth.metrics.point_sets import spread
from lidarsynth.networks.device import usual_torch
from lidarsynth.networks.minkowski_unet import MinkowskiUNet
from lidarsynth.networks.pointnet import read_pointnet
from lidarsynth.networks.rangenet import RangeNet
from lidarsynth.networks.rangenet_archive import read_lidm_rangenet, read_rangenet
from lidarsynth.networks.sparse_weights import read_sparse
from lidarsynth.networks.spvcnn import SPVCNN
from lidarsynth.networks.street_features import StreetFeatures
from lidarsynth.weights.download import cache_folder, download
from lidarsynth.weights.load import load_parts, shipped

SAVE_EVERY = 60.0  # seconds between two writings of unfinished statistics: what a kill can cost
OnImages: TypeAlias = Callable[[str, int, int], object] | None  # (what, images done, images in all), for progress bars

# Kind of network -> where the official files lie: the RangeNet repository's models, and the copy of TreeGAN's PointNet
# that R2DM's evaluation takes. No checksums are published; what is read is tensors only, of the right names and shapes.
URLS: dict[str, str] = {
    "rangenet": "https://www.ipb.uni-bonn.de/html/projects/bonnetal/lidar/semantic/models",
    "pointnet": "https://github.com/microsoft/SpareNet/raw/HEAD/Frechet",
    # LiDM's weights as R2Flow's authors packed them; LiDM's own lie in folders on a drive that no program can ask
    "lidm-rangenet": "https://github.com/kazuto1011/r2flow/releases/download/weights",
    "minkowskinet": "https://github.com/kazuto1011/r2flow/releases/download/weights",
    "spvcnn": "https://github.com/kazuto1011/r2flow/releases/download/weights",
}


@dataclass(frozen=True)
class Loaded:
    """A protocol's networks that are here, the SHA-256 of their files, and why the others are not."""

    networks: dict[str, nn.Module] = field(default_factory=dict)
    weights: dict[str, str] = field(default_factory=dict)
    missing: dict[str, str] = field(default_factory=dict)


@usual_torch()
def load_networks(protocol: EvaluationProtocol, width: int, device: str = "cpu", on_images: OnImages = None) -> Loaded:
    """A protocol's networks, shipped or downloaded once into the cache folder; of the others, why they are missing.

    Raises ValueError for a damaged or another file.
    """
    loaded = Loaded()
    for network in protocol.networks:
        name = network.file(width)
        if name is None:
            widths = ", ".join(str(w) for w, _ in network.files)
            loaded.missing[network.kind] = f"no official {network.kind} for {width} columns, only for {widths}"
            continue
        if name in (own := shipped()):
            rangenet = _read_shipped(name)
            loaded.networks[network.kind] = (rangenet if protocol.pairs else StreetFeatures(rangenet)).to(device)
            loaded.weights[network.kind] = sha256(own[name] / WEIGHTS)
            continue
        path, folder = cache_folder() / name, cache_folder() / name.removesuffix(".tar.gz")
        path = folder if folder.is_dir() else path
        try:
            for done, total in download(f"{URLS[network.kind]}/{name}", path) if not path.is_dir() else ():
                if on_images:
                    on_images(f"download {name}", done, total or done)
        except ValueError as error:
            loaded.missing[network.kind] = str(error)
            continue
        try:
            loaded.networks[network.kind] = _read_network(network, path).to(device)
        except ValueError as error:
            raise ValueError(f"{error}; delete the file to download it again") from None
        loaded.weights[network.kind] = _sha256_of(path)
    return loaded


def _sha256_of(path: Path) -> str:
    """Of a file, or of all files of a folder."""
    if path.is_file():
        return sha256(path)
    return hashlib.sha256(
        "".join(sha256(file) for file in sorted(path.iterdir()) if file.is_file()).encode()
    ).hexdigest()


def _read_shipped(word: str) -> RangeNet:
    rangenet = load_parts(word)[1]
    assert isinstance(rangenet, RangeNet)
    return rangenet


def _read_network(network: Network, path: Path) -> nn.Module:
    if network.kind == "pointnet":
        return read_pointnet(path)
    if network.kind == "minkowskinet" or network.kind == "spvcnn":
        return read_sparse(path, network.kind)
    rangenet = read_lidm_rangenet(path) if network.kind == "lidm-rangenet" else read_rangenet(path)
    if rangenet.layers != network.layers:
        raise ValueError(f"{path}: expected RangeNet-{network.layers}, found RangeNet-{rangenet.layers}")
    return rangenet


@dataclass(frozen=True)
class Selection:
    """Numbers of the images that count for features, for the bird's eye view, and for the measures of point sets.

    Of scans as lists of points: for features, for the JSD, and for the matching distance.
    """

    features: frozenset[int]
    bev: frozenset[int]
    sets: frozenset[int] = frozenset()

    def numbers(self) -> list[int]:
        return sorted(self.features | self.bev | self.sets)


def select(
    protocol: EvaluationProtocol, role: Literal["samples", "real"], names: Sequence[str], samples: int = 0
) -> Selection:
    """Which images of a set the protocol takes; `samples` is how many there are to judge.

    Where no name is of the protocol's sequences all are taken; `unlike_names` tells.
    """
    if role == "samples":
        limits = (protocol.samples, protocol.samples_bev)
        features, bev = (frozenset(range(len(names))[:limit]) for limit in limits)
        if protocol.clouds:
            return Selection(features, bev, bev & frozenset(range(len(names))[: protocol.clouds.samples]))
        return Selection(features, bev, _spread(protocol, range(len(names))[: protocol.samples]))
    chosen = []
    for sequences, limit in ((protocol.sequences, protocol.real), (protocol.sequences_bev, protocol.real_bev)):
        of_protocol = [i for i, name in enumerate(names) if any(part in name for part in sequences)]
        numbers = of_protocol or list(range(len(names)))
        if limit is not None:
            numbers.sort(key=lambda i: _place(names[i]))
            random.Random(0).shuffle(numbers)  # as R2DM and LiDARGen order their real scans
            numbers = numbers[: samples if limit == 0 else limit]
        chosen.append(frozenset(numbers))
    if protocol.clouds:
        matched = sorted(chosen[1])
        if protocol.clouds.real is not None:
            random.Random(0).shuffle(matched)
        return Selection(chosen[0], chosen[1], frozenset(matched[: protocol.clouds.real]))
    return Selection(chosen[0], chosen[1], _spread(protocol, range(len(names))))


def _place(name: str) -> int:
    """Where R2DM's data set has the drive of a scan of KITTI-360: training drives first, then 0 and 2. Its program
    shuffles numbers by this order, and a folder's paths have another; what is of no such drive stays as it is, last."""
    return next(
        (k for k, drive in enumerate(SPLITS["all"]) if f"2013_05_28_drive_{drive:04d}_" in name), len(SPLITS["all"])
    )


def _spread(protocol: EvaluationProtocol, numbers: range) -> frozenset[int]:
    return frozenset(numbers[k] for k in spread(len(numbers), protocol.sets.images)) if protocol.sets else frozenset()


def unlike_names(protocol: EvaluationProtocol, names: Sequence[str]) -> tuple[str, ...]:
    """A warning where the protocol takes some sequences of the reference only, and none of the names is theirs; of the
    features alone, or of the bird's eye views, where these are of other sequences, which are there."""
    both = (("features ", protocol.sequences), ("bird's eye views ", protocol.sequences_bev))
    lacking = [(what, own) for what, own in both if own and not any(part in name for name in names for part in own)]
    if not lacking:
        return ()
    what, wanted = lacking[0][0] if len(lacking) == 1 else "", sorted({part for _, own in lacking for part in own})
    sequences = ", ".join(wanted)
    return (f"{protocol.title} compares {what}with the sequences {sequences}; the reference has none, all were taken",)


def gather(
    images: ImageSet,
    numbers: Sequence[int],
    chosen: Selection,
    empty: Statistics,
    projection: str,
    unfinished: Path | None = None,
    batch_size: int = 4,
    on_images: OnImages = None,
) -> Statistics:
    """Statistics of the images `numbers`, added to `empty`; killed at any moment, the next call goes on.

    unfinished  where to keep what is gathered so far, or None; its name must tell images, protocol and weights apart.
                The file stays until the caller takes it away
    """
    statistics, done = empty, 0
    if unfinished and unfinished.is_file():
        with suppress(ValueError, KeyError):  # damaged: begin again
            found, metadata = load_statistics(unfinished, empty.protocol)
            done = int(metadata["done"])
            found.networks, found.weights = empty.networks, empty.weights
            statistics = found
    saved = time.monotonic()
    for start in range(done, len(numbers), batch_size):
        batch = numbers[start : start + batch_size]
        features, bev, sets = (
            [i in numbered for i in batch] for numbered in (chosen.features, chosen.bev, chosen.sets)
        )
        if clouds := empty.protocol.clouds:
            scans = [images.points(i, empty.sensor, clouds, empty.role == "real") for i in batch]
            statistics.update_clouds(scans, features, bev, sets)
        else:
            real, resizing = empty.role == "real", empty.protocol.resizing
            arrays = [images.image(i, empty.sensor, projection, real, resizing) for i in batch]
            _check_voxels(empty, images, batch, arrays)
            statistics.update(arrays, features, bev, sets)
        if on_images:
            on_images(empty.role, start + len(batch), len(numbers))
        if unfinished and time.monotonic() - saved > SAVE_EVERY:
            with suppress(OSError):  # the cache is for going on only
                save_statistics(unfinished, statistics, {"done": str(start + len(batch))})
            saved = time.monotonic()
    return statistics


def _check_voxels(empty: Statistics, images: ImageSet, batch: Sequence[int], arrays: Sequence[RangeImage]) -> None:
    """Raises ValueError by the name of an image without a point within the protocol's limits, of which a network of
    voxels says nothing."""
    if not any(isinstance(network, MinkowskiUNet | SPVCNN) for network in empty.networks.values()):
        return
    for i, image in zip(batch, arrays, strict=True):
        if not gated(image, empty.protocol, empty.role).any():
            raise ValueError(f"{images.names[i]}: expected points between {empty.protocol.near:g} and "
                             f"{empty.protocol.far:g} m, found none of {int(image.mask.sum())}")  # fmt: skip


def part_of(numbers: list[int], part: str | None) -> list[int]:
    """Part `i/n` of a list, i from 1; all of it for None. Raises ValueError."""
    if part is None:
        return numbers
    words = part.split("/")
    if len(words) != 2 or not all(w.isdecimal() for w in words) or not 1 <= int(words[0]) <= int(words[1]):
        raise ValueError(f"expected a part such as 1/2, found {part!r}")
    i, n = map(int, words)
    return numbers[len(numbers) * (i - 1) // n : len(numbers) * i // n]
