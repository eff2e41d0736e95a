"""What a protocol is: a frozen record with a name and a version, and the records it is made of; pure Python."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

Side = Literal["samples", "real", "bev"]
# rangenet: five channels; lidm-rangenet: four, without remission; the last two see voxels
Kind = Literal["rangenet", "pointnet", "lidm-rangenet", "minkowskinet", "spvcnn"]


@dataclass(frozen=True)
class Network:
    """A feature network with published weights, and which of its values are the features."""

    kind: Kind
    files: tuple[tuple[int, str], ...]  # image width -> official file, or word of shipped weights; width 0: any
    layer: str  # in words
    features: int  # numbers per image
    layers: int = 0  # of a RangeNet, 21 or 53

    def file(self, width: int) -> str | None:
        """The official file for images of this width, or None where there is none."""
        return dict(self.files).get(width, dict(self.files).get(0))


@dataclass(frozen=True)
class Bev:
    """Bird's-eye-view histograms: gate near < |xyz| < far in metres, strict; bins x bins cells over +-extent metres."""

    bins: int = 100
    extent: float = 80.0
    near: float = 3.0
    far: float = 70.0
    width: float = 0.5  # of the Gaussian kernel between histograms of sum 1


@dataclass(frozen=True)
class Sets:
    """Scans as sets of their farthest points, and the measures between sets (DUSty, after Achlioptas et al. 2018)."""

    images: int = 2048  # evenly spaced from the first to the last
    points: int = 2048  # of each, the first being number 0
    clear: float = 1e-3  # squared norm in units of `scale` up to which points are not chosen
    scale: float = 80.0  # metres; points are divided by it
    bins: int = 28  # of the grid within a sphere, whose occupancy gives the JSD of points / 2
    pairs: int = 400  # earth mover's distances that are computed; two to ten seconds each at 2,048 points


@dataclass(frozen=True)
class Clouds:
    """Scans as lists of points, which are judged as they come and not drawn into the reference's images (LiDM)."""

    near: float = 1.0  # metres, strict; of what the networks see, and of what is drawn
    far: float = 56.0
    redrawn: bool = True  # real scans go through LiDM's image and range code first
    gated: bool = False  # samples lose what lies outside near to far, as real scans do
    cell: float = 0.05  # metres; cells of +-extent whose occupation gives the JSD
    extent: float = 50.0
    matching: float = 0.5  # metres; cells of the minimum matching distance
    samples: int | None = None  # the first so many take part in the matching; None = all
    real: int | None = None  # so many, after `Random(0).shuffle`


@dataclass(frozen=True)
class Row:
    """One number of the table."""

    name: str
    measure: str  # a word of `measures.MEASURES` or, where images are compared in pairs, of `pairs.MEASURES`
    formula: str  # what is squared or rooted, in words
    network: Kind | None = None  # whose features it needs
    scale: float = 1.0  # the table shows value * scale
    unit: str = ""
    digits: int = 3


@dataclass(frozen=True)
class EvaluationProtocol:
    """How samples are judged against a reference. Raises nothing: its fields are plain.

    sensor, height, width  the images; scans without an image are projected into these
    near, far              metres, strict: pixels outside count as empty, on the sides `gated`
    resizing               how larger reference images come to the samples' size, a word of `projection.thin`
    samples, samples_bev   the first so many, sorted by name, are judged by features and by BEV; None = all
    real, real_bev         so many, after `Random(0).shuffle`; None = all, 0 = as many as samples
    sequences, sequences_bev  parts of the names of the reference's sequences; () = all
    reproject              samples are turned into points and drawn again for image features (LiDARGen's quirk)
    subsets, subset_size   of the polynomial MMD, k(x, y) = (x.y / D + 1)^3
    keep                   features of at most so many images stay for that MMD, those of the BEV; and histograms
    measured               real x, y, z are those of the measured points, not of their pixels' rays
    rays                   x, y, z are those of their pixels' rays, where points are known too
    sets                   scans as small sets of points, or None
    clouds                 scans as lists of points, or None; images, gates and projection are then not of account
    pairs                  sample i is compared with reference i
    absent                 rows of the published table that nobody here can compute -> why
    """

    name: str
    version: int
    source: str
    rows: tuple[Row, ...]
    networks: tuple[Network, ...] = ()
    bev: Bev | None = None
    sensor: str = "hdl-64e"
    height: int = 64
    width: int = 1024
    projection: str = "spherical"
    near: float = 0.5
    far: float = 63.0
    gated: tuple[Side, ...] = ("samples", "real", "bev")
    resizing: str = "nearest-exact"
    samples: int | None = 10_000
    samples_bev: int | None = 10_000
    real: int | None = None
    real_bev: int | None = 10_000
    sequences: tuple[str, ...] = ()
    sequences_bev: tuple[str, ...] = ()
    reproject: bool = False
    subsets: int = 100
    subset_size: int = 1000
    keep: int = 10_000
    beam_step: float = 0.5  # metres, bins of the range histogram per beam
    measured: bool = False
    rays: bool = False
    sets: Sets | None = None
    clouds: Clouds | None = None
    pairs: bool = False
    absent: tuple[tuple[str, str], ...] = ()
    notes: tuple[str, ...] = ()

    @property
    def title(self) -> str:
        return f"{self.name} v{self.version}"

    def network(self, kind: str | None) -> Network | None:
        """The protocol's network of this kind, or None."""
        return next((network for network in self.networks if network.kind == kind), None)
