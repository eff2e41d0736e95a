"""What a protocol keeps of a set of images: moments, some features, histograms. Streams, merges, fits in a file."""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, replace
from hashlib import blake2b, sha256
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save as serialized
from torch import Tensor, nn

from lidarsynth.evaluation.features import cloud_features, drawn_again, features, gated
from lidarsynth.evaluation.image_sets import Cloud
from lidarsynth.evaluation.protocol import EvaluationProtocol, Side
from lidarsynth.evaluation.protocols import get_protocol
from lidarsynth.lidar.beams import same_beams
from lidarsynth.lidar.scan import RangeImage
from lidarsynth.lidar.sensor import Sensor, from_dict
from lidarsynth.lidar.small_file import LARGEST_WEIGHTS, check_regular
from lidarsynth.lidar.whole_file import write_whole
from lidarsynth.metrics.bev import BevCounts
from lidarsynth.metrics.distributions import Array, Moments
from lidarsynth.metrics.occupancy import Occupancy
from lidarsynth.metrics.point_sets import farthest_points
from lidarsynth.metrics.sensor_report import BeamCounts
from lidarsynth.metrics.sharpness import Sharpness
from lidarsynth.networks.device import usual_torch

FORMAT = "lidarsynth statistics 1"
GATHERED = 3  # goes up where the same files come to be gathered otherwise: what was kept before is then made anew
Networks = Mapping[str, nn.Module]  # kind -> a network in evaluation mode; those a protocol names and that are there


class Statistics:
    """Statistics of one set of images under a protocol; of bounded size, whatever the number of images.

    role      "samples" or "real": a protocol may treat the two differently
    networks  whose features are taken; without one its rows become N/A
    weights   kind -> SHA-256 of each network's file
    count     images so far, for features; `bev.count` is that of the histograms
    lit       images with any reflectance above 0
    measured  images that hold the measured points themselves; those of others lie on their pixels' rays
    others    images of other beams than the sensor's, so that rows of the image are no beam's
    digest    hexadecimal hash of all images, whatever their order

    Two sets of different images merge into what one pass over all of them gives.
    """

    @usual_torch()
    def __init__(
        self,
        protocol: EvaluationProtocol,
        sensor: Sensor,
        role: Literal["samples", "real"],
        networks: Networks | None = None,
        weights: Mapping[str, str] | None = None,
    ):
        self.protocol, self.sensor = protocol, sensor
        self.role: Side = role
        self.networks, self.weights = dict(networks or {}), dict(weights or {})
        self.count = self.lit = self.measured = self.others = self._digest = 0
        self.moments: dict[str, Moments] = {}
        self._kept: dict[str, list[Tensor]] = {}
        self._sets: list[Tensor] = []
        grid = protocol.bev
        self.bev = BevCounts(grid.bins, grid.extent, grid.near, grid.far, protocol.keep) if grid else None
        far = min(protocol.far, sensor.max_range)  # so that sensors of other limits compare
        counted = {row.measure for row in protocol.rows} & {"drop-rate", "beam-range"}
        self.beams = BeamCounts(replace(sensor, min_range=0.0, max_range=far), protocol.beam_step) if counted else None
        sharp = any(row.measure.startswith("sharp-") for row in protocol.rows)
        self.sharpness = Sharpness() if sharp else None
        c = protocol.clouds
        self.occupancy = Occupancy(c.cell, c.matching, c.extent) if c else None

    @property
    def digest(self) -> str:
        return f"{self._digest:032x}"

    def features(self, kind: str) -> Tensor:
        """(n, D) float32: the kept features of a network, on the CPU."""
        self._kept[kind] = [torch.cat(self._kept[kind])]
        return self._kept[kind][0]

    def sets(self) -> np.ndarray:
        """(n, P, 3) float32: the farthest points of the images taken for the measures of point sets."""
        size = self.protocol.sets.points if self.protocol.sets else 0
        return torch.cat([torch.zeros(0, size, 3), *self._sets]).numpy()

    @usual_torch()
    def update_clouds(
        self, scans: Sequence[Cloud], features: Sequence[bool], counted: Sequence[bool], matched: Sequence[bool]
    ) -> None:
        """Take in a batch of scans; which of them count for the networks, for the JSD, for the matching distance.

        Raises ValueError for a protocol of images, and for points that are not finite or out of every range.
        """
        clouds = self.protocol.clouds
        if not clouds or self.occupancy is None:
            raise ValueError(f"{self.protocol.title} judges images: expected images, found lists of points")
        self._digest = (self._digest + sum(map(hash_of_points, scans))) % (1 << 128)
        chosen = [scan.xyz for scan, wanted in zip(scans, features, strict=True) if wanted]
        self.count += len(chosen)
        for kind, network in self.networks.items() if chosen else ():
            self.add_features(kind, cloud_features(network, chosen, clouds), [False] * len(chosen))
        for scan, count, match in zip(scans, counted, matched, strict=True):
            self.occupancy.update(scan.xyz, count, match)

    @usual_torch()
    def update(
        self, images: Sequence[RangeImage], features: Sequence[bool], bev: Sequence[bool], sets: Sequence[bool] = ()
    ) -> None:
        """Take in a batch; `features`, `bev` and `sets` say which of the images count for which.

        Raises ValueError for an image of another size than the sensor's, or with values that are not finite.
        """
        for image in images:
            self._check(image)
            self.others += not same_beams(image.sensor, self.sensor)
            self._digest = (self._digest + hash_of(image)) % (1 << 128)
        self.update_features([i for i, n in zip(images, features, strict=True) if n],
                             [b for b, n in zip(bev, features, strict=True) if n])  # fmt: skip
        self.update_histograms([image for image, needed in zip(images, bev, strict=True) if needed])
        self.update_sets([image for image, needed in zip(images, sets, strict=False) if needed])

    def _check(self, image: RangeImage) -> None:
        if image.shape != (self.sensor.height, self.sensor.width):
            size = f"{self.sensor.height} x {self.sensor.width}"
            raise ValueError(f"expected images of one size, {size}, found one of {image.shape[0]} x {image.shape[1]}")
        for name in ("range", "reflectance"):
            values = getattr(image, name)
            if not np.isfinite(values).all():
                raise ValueError(f"expected a finite {name}, found {np.sum(~np.isfinite(values))} pixels of NaN or "
                                 "infinity")  # fmt: skip

    def update_features(self, images: Sequence[RangeImage], keep: Sequence[bool]) -> None:
        """Take in images for the feature networks only; the features of those to `keep` stay one by one."""
        self.count += len(images)
        self.lit += sum(bool((image.reflectance[image.mask] > 0).any()) for image in images)
        self.measured += sum(image.xyz is not None for image in images)
        if not images or not self.networks:
            return
        if self.protocol.reproject and self.role == "samples":
            images = [drawn_again(image, gated(image, self.protocol, "samples")) for image in images]
        masks = np.stack([gated(image, self.protocol, self.role) for image in images])
        xyz = np.stack([self._points(image) for image in images]) * masks[..., None]
        for kind, network in self.networks.items():
            record = self.protocol.network(kind)
            self.add_features(kind, features(network, images, xyz, masks, record.features if record else 0), keep)

    def _points(self, image: RangeImage) -> np.ndarray:
        return image.sensor.points(image.range) if self.protocol.rays else image.points()

    def add_features(self, kind: str, values: Array, keep: Iterable[bool]) -> None:
        """Take in features (B, D) of a network that ran elsewhere. Raises ValueError for NaN or another D."""
        if kind not in self.moments:  # on the network's device: a large covariance is slow to add to on a CPU
            self.moments[kind] = Moments(values.shape[1], values.device if isinstance(values, Tensor) else "cpu")
        self.moments[kind].update(values)
        kept = torch.as_tensor(values).cpu().float()[torch.tensor(list(keep), dtype=torch.bool)]
        free = self.protocol.keep - sum(map(len, self._kept.setdefault(kind, [])))
        self._kept[kind].append(kept[: max(free, 0)])

    def update_histograms(self, images: Sequence[RangeImage]) -> None:
        """Take in images for the bird's eye view and the beams only."""
        if not images:
            return
        masks = np.stack([gated(image, self.protocol, "bev") for image in images])
        if self.bev:
            xyz = np.stack([self._points(image) for image in images]) * masks[..., None]
            self.bev.update(xyz.reshape(len(images), -1, 3))
        if self.beams:
            self.beams.update(np.stack([image.range for image in images]), masks)
        if self.sharpness:
            for image, mask in zip(images, masks, strict=True):
                self.sharpness.update(image, mask)

    def update_sets(self, images: Sequence[RangeImage]) -> None:
        """Take in images for the measures of point sets only."""
        sets = self.protocol.sets
        if not sets:
            return
        for image in images:
            xyz = (self._points(image) * gated(image, self.protocol, self.role)[..., None]).reshape(-1, 3) / sets.scale
            chosen = xyz[farthest_points(xyz, sets.points, sets.clear)]
            self._sets.append(torch.from_numpy(chosen.astype(np.float32))[None])

    @usual_torch()
    def merge(self, other: Statistics) -> None:
        """Take in all that `other` has seen. Raises ValueError for another protocol, sensor, role or weights."""
        both = self.count and other.count  # a part whose images are none of the features' has seen no network
        own, its = ((s.protocol, s.sensor, s.role, s.weights, set(s.moments) if both else 0) for s in (self, other))
        if own != its:
            wrong = next(i for i, (a, b) in enumerate(zip(own, its, strict=True)) if a != b)
            name = ("protocol", "sensor", "role", "weights", "networks")[wrong]
            found = _apart(own[wrong], its[wrong])
            raise ValueError(f"expected statistics of one {name}, found {found[0]:.100} and {found[1]:.100}")
        self.count, self.lit, self.measured = (
            self.count + other.count, self.lit + other.lit, self.measured + other.measured
        )  # fmt: skip
        self.others += other.others
        self._digest = (self._digest + other._digest) % (1 << 128)
        for kind, moments in other.moments.items():
            self.moments.setdefault(kind, Moments(len(moments.mean), moments.mean.device)).merge(moments)
            free = self.protocol.keep - sum(map(len, self._kept.setdefault(kind, [])))
            self._kept[kind].append(other.features(kind)[: max(free, 0)])
        self._sets += other._sets
        if self.occupancy and other.occupancy:
            self.occupancy.merge(other.occupancy)
        if self.bev and other.bev:
            self.bev.merge(other.bev)
        if self.beams and other.beams:
            self.beams.merge(other.beams)
        if self.sharpness and other.sharpness:
            self.sharpness.merge(other.sharpness)

    @usual_torch()
    def tensors(self) -> dict[str, Tensor]:
        """Everything counted, by name."""
        state = {"counts": torch.tensor([self.count, self.lit, self.measured])}
        state |= {"others": torch.tensor([self.others])} if self.others else {}
        for kind, moments in self.moments.items():
            state |= {f"{kind}.moments.{name}": value.cpu() for name, value in moments.state().items()}
            state[f"{kind}.features"] = self.features(kind)
        state |= {f"bev.{name}": value for name, value in (self.bev.state() if self.bev else {}).items()}
        state |= {
            f"occupancy.{name}": value for name, value in (self.occupancy.state() if self.occupancy else {}).items()
        }
        if self.beams:
            state["beams.pixels"] = torch.from_numpy(self.beams.pixels)
            state["beams.histogram"] = torch.from_numpy(self.beams.histogram)
        if self.sharpness:
            state |= {f"sharpness.{kind}": torch.from_numpy(counts) for kind, counts in self.sharpness.counts.items()}
        if self.protocol.sets:
            state["sets"] = torch.from_numpy(self.sets())
        return {name: value.contiguous() for name, value in state.items()}

    def restore(self, state: Mapping[str, Tensor], digest: str) -> None:
        """Fill a new object with what `tensors` and `digest` of another gave."""
        self.count, self.lit, self.measured = state["counts"].tolist()
        self.others = int(state["others"]) if "others" in state else 0
        self._digest = int(digest, 16)
        for kind in [name.removesuffix(".features") for name in state if name.endswith(".features")]:
            self.moments[kind] = Moments.from_state(_under(state, f"{kind}.moments."))
            self._kept[kind] = [state[f"{kind}.features"]]
        if self.bev:
            self.bev.load_state(_under(state, "bev."))
        if self.occupancy:
            self.occupancy.load_state(_under(state, "occupancy."))
        if self.beams:
            self.beams.pixels += state["beams.pixels"].numpy()
            self.beams.histogram += state["beams.histogram"].numpy()
        if self.sharpness:
            self.sharpness.counts = {kind: v.numpy().copy() for kind, v in _under(state, "sharpness.").items()}
        if self.protocol.sets:
            self._sets = [state["sets"]]

    def __getstate__(self) -> dict[str, Any]:
        """For another process: all but the networks."""
        return {**vars(self), "networks": {}}


def _apart(own: object, its: object) -> tuple[str, str]:
    """Two different things of one kind in words: of sensors, the first field that differs."""
    if isinstance(own, EvaluationProtocol) and isinstance(its, EvaluationProtocol):
        return own.title, its.title
    if isinstance(own, Sensor) and isinstance(its, Sensor):
        name = next(name for name, value in vars(own).items() if value != getattr(its, name))
        return tuple(f"{sensor.name} of {name} {getattr(sensor, name)}" for sensor in (own, its))  # type: ignore[return-value]
    return str(own), str(its)


def hash_of(image: RangeImage) -> int:
    """128 bits of range, reflectance, mask, points, and of the beams and limits of the sensor, whatever its name; the
    sum of those of a set is the same in any order."""
    s = image.sensor
    told = repr((s.elevations, s.offsets, s.edges, s.min_range, s.max_range)).encode()
    arrays = image.range, image.reflectance, image.mask, image.points()[image.mask]
    content = told + b"".join(np.ascontiguousarray(v).tobytes() for v in arrays)
    return int(blake2b(content, digest_size=16).hexdigest(), 16)


def hash_of_points(scan: Cloud) -> int:
    """128 bits of all points of a scan, which are the same whether it is judged or the reference; as `hash_of`."""
    return int(blake2b(np.ascontiguousarray(scan.held, np.float32).tobytes(), digest_size=16).hexdigest(), 16)


def _under(state: Mapping[str, Tensor], prefix: str) -> dict[str, Tensor]:
    return {name.removeprefix(prefix): value for name, value in state.items() if name.startswith(prefix)}


def save_statistics(path: Path, statistics: Statistics, extra: Mapping[str, str] | None = None) -> str:
    """Write a `.safetensors` file, whole or not at all; returns the SHA-256 of its content, which it also holds.

    extra  more to remember, such as where the images came from
    """
    tensors = statistics.tensors()
    metadata = {
        "format": FORMAT,
        "protocol": statistics.protocol.name,
        "definition": definition(statistics.protocol),
        "gathered": str(GATHERED),
        "role": statistics.role,
        "sensor": json.dumps(statistics.sensor.to_dict()),
        "weights": json.dumps(statistics.weights),
        "digest": statistics.digest,
        **(extra or {}),
    }
    metadata["sha256"] = _content(tensors, metadata)
    path.parent.mkdir(parents=True, exist_ok=True)
    write_whole(path, serialized(tensors, metadata))
    return metadata["sha256"]


@usual_torch()
def load_statistics(path: Path, protocol: EvaluationProtocol | None = None) -> tuple[Statistics, dict[str, str]]:
    """Statistics that `save_statistics` wrote, verified, and the file's metadata.

    protocol  what they must be of; by default the published one of the name in the file
    Raises ValueError for another kind of file, another protocol or version, or a content that is not the one hashed.
    """
    try:
        metadata = load_metadata(path)
        with safe_open(path, "pt") as file:
            tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118, not a dict
    except (OSError, SafetensorError) as error:
        raise ValueError(f"{path}: expected a file of statistics, found {error!s:.100}") from None
    protocol = protocol or get_protocol(metadata.get("protocol", ""))
    if metadata.get("definition") != definition(protocol):
        raise ValueError(f"{path}: expected statistics of {protocol.title} as defined here, found those of "
                         f"{metadata.get('protocol')}, {metadata.get('definition')}")  # fmt: skip
    if _content(tensors, metadata) != metadata.get("sha256"):
        raise ValueError(f"{path}: expected the content of SHA-256 {metadata.get('sha256')!s:.16}..., found another")
    try:
        role: Any = metadata["role"]
        sensor = from_dict(json.loads(metadata["sensor"]), str(path))
        statistics = Statistics(protocol, sensor, role, weights=json.loads(metadata["weights"]))
        statistics.restore(tensors, metadata["digest"])
    except (KeyError, TypeError, RuntimeError) as error:  # made by other hands
        raise ValueError(f"{path}: expected the fields of {FORMAT!r}, found other ones: {error!s:.80}") from None
    return statistics, metadata


def load_metadata(path: Path) -> dict[str, str]:
    """What `save_statistics` wrote beside the numbers, which are not read. Raises ValueError for no such file."""
    try:
        check_regular(path, LARGEST_WEIGHTS)
        with safe_open(path, "pt") as file:
            metadata = dict(file.metadata() or {})
    except (OSError, SafetensorError) as error:
        raise ValueError(f"{path}: expected a file of statistics, found {error!s:.100}") from None
    if metadata.get("format") != FORMAT:
        raise ValueError(f"{path}: expected {FORMAT!r}, found {metadata.get('format')!r:.40}")
    return metadata


def definition(protocol: EvaluationProtocol) -> str:
    """Version and hash of a protocol's record: two programs that agree in it compute the same statistics."""
    fields = asdict(protocol)
    for text in ("source", "notes", "absent", "rows"):  # what is said and shown, not what is gathered
        del fields[text]
    for name in ("clouds", "rays"):  # so that protocols from before them keep their hash
        if not fields[name]:
            del fields[name]
    fields["measures"] = sorted({row.measure for row in protocol.rows})
    return f"v{protocol.version} {sha256(json.dumps(fields, sort_keys=True).encode()).hexdigest()[:16]}"


def _content(tensors: Mapping[str, Tensor], metadata: Mapping[str, str]) -> str:
    told = {name: value for name, value in metadata.items() if name != "sha256"}
    digest = sha256(json.dumps(told, sort_keys=True).encode())
    for name, tensor in sorted(tensors.items()):
        digest.update(f"{name} {tensor.dtype} {tuple(tensor.shape)}".encode())
        digest.update(tensor.numpy().data)
    return digest.hexdigest()
