"""Protocols: what exactly a number in a table means. A frozen record each, with a name and a version; pure Python.

The same generator is reported with a JSD of 0.0305, 0.0578, 0.168 and 0.32 in four papers, because every program gates,
bins, pools and roots differently. A number is compared with another of the same protocol and version only.
"""

from __future__ import annotations

from dataclasses import replace

from lidarsynth.evaluation.formulas import FRECHET, JSD, KERNEL, MMD
from lidarsynth.evaluation.lidm_protocols import LIDM, LIDM_RECONSTRUCTION, R2FLOW, R3DPA
from lidarsynth.evaluation.protocol import Bev, EvaluationProtocol, Network, Row, Sets

RANGENET_53 = Network(
    "rangenet",
    ((2048, "darknet53.tar.gz"), (1024, "darknet53-1024.tar.gz"), (512, "darknet53-512.tar.gz")),
    "decoder output before dropout and head, 4096 positions random.Random(0).sample(range(32 H W), 4096), C-major",
    4096,
    layers=53,
)
POINTNET = Network(
    "pointnet",
    ((0, "cls_model_39.pth"),),
    "maximum over points (1024), hidden layers (512, 256), logits (16) of points / 80 m, removed ones at the origin",
    1808,
)

_FRD = Row("FRD", "frechet", FRECHET, "rangenet", digits=1)
_FPD = Row("FPD", "frechet", FRECHET, "pointnet")
_BEV_ROWS = (Row("MMD x1e4", "bev-mmd", MMD, scale=1e4), Row("JSD x1e2", "bev-jsd", JSD, scale=1e2))
_BEAMS = (
    Row("no return, per beam", "drop-rate", "mean over beams of |share without return - reference's|", None, 100, "%"),
    Row("range, per beam", "beam-range", "mean over beams of the Wasserstein-1 distance of ranges", None, 1, "m"),
)

R2DM = EvaluationProtocol(
    "r2dm-2024",
    1,
    "Nakashima & Kurazume, ICRA 2024, table II and the official evaluation program",
    (
        _FRD,
        _FPD,
        *_BEV_ROWS,
        Row("FRD squared MMD", "kernel", KERNEL, "rangenet"),
        Row("FPD squared MMD", "kernel", KERNEL, "pointnet"),
    ),
    (RANGENET_53, POINTNET),
    Bev(),
    measured=True,
    notes=(
        "all real images for FRD and FPD; BEV takes 10,000 of them after Random(0).shuffle",
        "the squared MMDs are drawn from a seeded generator, the official one is not seeded; and, so that memory stays "
        "bounded, from the features of the BEV's 10,000",
    ),
)

LIDARGEN = EvaluationProtocol(
    "lidargen-2022",
    2,
    "Zyrianov et al., ECCV 2022, and the official evaluation programs",
    (_FRD, *_BEV_ROWS),
    (RANGENET_53,),
    Bev(),
    sensor="hdl-64e-lidargen",
    gated=("samples",),
    samples=1100,
    samples_bev=None,
    real=0,
    real_bev=None,
    sequences=("0000_sync", "0001_sync"),
    sequences_bev=("0000_sync", "0002_sync"),
    reproject=True,
    keep=40_000,
    measured=True,
    notes=(
        "for the FRD samples are gated, turned into points and drawn again, and their first point is lost; the real "
        "scan's first point is not known in an image and stays",
        "no epsilon on the covariance: the official program adds 1e-6 only where its root is not finite",
        "real scans come within their sensor's limits, the official program has none: those of hdl-64e-lidargen are "
        "0.5 to 130 m, of R2DM's hdl-64e 1.45 to 80 m",
    ),
)

_DUSTY_ROWS = (
    Row("JSD", "sets-jsd", "Jensen-Shannon divergence in bits, not rooted, 28^3 grid in a sphere, points pooled"),
    Row("COV", "sets-coverage", "share of real sets that are the nearest of some sample, by EMD", None, 100, "%", 2),
    Row("MMD", "sets-mmd", "mean over real sets of the EMD to the nearest sample, per point, in 80 m", digits=4),
    Row("1-NNA", "sets-1nna", "share of sets whose nearest other one, by EMD, is of their side", None, 100, "%", 2),
)
DUSTY = EvaluationProtocol(
    "dusty-2023",
    2,
    "Nakashima et al., WACV 2023, test script",
    (_FPD, Row("KPD", "kernel", KERNEL, "pointnet"), *_DUSTY_ROWS),
    (POINTNET,),
    sensor="hdl-64e-dusty",
    width=512,
    projection="unfolding",
    near=1.4499,  # both limits, 1.45 and 80 m, count
    far=80.0001,
    resizing="nearest",
    samples=50_000,
    rays=True,
    sets=Sets(),
    absent=(("SWD", "sliced Wasserstein distance of Laplacian pyramids is not here"),),
    notes=(
        "points are those of pixels' rays, of real scans too: an image's range along the mean beams of hdl-64e-dusty; "
        "real scans keep columns 4k of 2048",
        "the reference of FPD and KPD is the training set, that of JSD, COV, MMD and 1-NNA the test set: run it twice",
        "KPD takes its subsets from at most 10,000 images per side",
        "JSD, COV, MMD and 1-NNA: 2,048 images evenly spaced, 2,048 farthest points of each; the earth mover's "
        "distance is exact here and approximate in the official program, and for up to 14 against 14 images only",
    ),
)
DUSTY_SMALL = replace(
    DUSTY,
    name="dusty-2023-small",
    source="lidarsynth: the measures of dusty-2023 between point sets, at a size that a CPU computes in two minutes",
    rows=_DUSTY_ROWS,
    networks=(),
    samples=None,
    sets=Sets(images=64, points=256, pairs=64 * 64 + 64 * 63),
    absent=(),
    notes=("64 images evenly spaced, 256 farthest points of each, exact earth mover's distance",),
)

R2DM_UPSAMPLING = EvaluationProtocol(
    "r2dm-upsampling-2024",
    1,
    "Nakashima & Kurazume, ICRA 2024, table III (4x beams); no program was published, so pixels are LiDARGen's",
    (
        Row("range MAE", "range-mae", "mean over all pixels, empty ones as 0 m", unit="m"),
        Row("reflectance MAE", "reflectance-mae", "mean over all pixels, empty ones as 0", digits=4),
        Row("IoU", "iou", "mean over 19 classes, pixels of class 0 left out (RangeNet)", "rangenet", 100, "%", 2),
        Row("IoU weighted", "iou-weighted", "by pixels, class 0 counts too (LiDARGen)", "rangenet", 100, "%", 2),
    ),
    (replace(RANGENET_53, layer="argmax of the logits, of the result and of the truth; no kNN"),),
    near=0.0,
    far=float("inf"),
    gated=(),
    samples=None,
    pairs=True,
    notes=("which of the two IoUs the paper has is not known",),
)

_VOXELS = "of the voxels of 0.1 m that points occupy, of each scan, averaged"
ILN = replace(
    R2DM_UPSAMPLING,
    name="iln-2022",
    version=2,
    source="Kwon, Sung & Yoon, Implicit LiDAR network, ICRA 2022, and its program; TULIP (CVPR 2024) has the same IoU",
    rows=(
        Row("range MAE", "range-mae-full", "mean over all pixels, cut at 100 m, no return as 100 m", unit="m"),
        Row("voxel IoU", "voxel-iou", f"intersection over union {_VOXELS}", None, 100, "%", 2),
        Row(
            "voxel precision",
            "voxel-precision",
            f"share {_VOXELS} in the result that are in the truth",
            None,
            100,
            "%",
            2,
        ),
        Row("voxel recall", "voxel-recall", f"share {_VOXELS} in the truth that are in the result", None, 100, "%", 2),
        Row("voxel F1", "voxel-f1", f"harmonic mean of both {_VOXELS}", None, 100, "%", 2),
    ),
    networks=(),
    notes=("points are those of pixels' rays, within the sensor's limits",),
)

BEV_1 = EvaluationProtocol(
    "bev-1",
    1,
    "lidarsynth: needs no weights; r2dm-2024's gates, grid and kernel, and a report per beam",
    (*_BEV_ROWS, *_BEAMS),
    (),
    Bev(),
    real=10_000,
)

_SPREAD = Row("FRD", "frechet", FRECHET, "rangenet")
STREET_1 = EvaluationProtocol(
    "street-1",
    1,
    "lidarsynth: features of a RangeNet that learned synthetic streets and comes with the package; no download",
    (_SPREAD, Row("FRD squared MMD x1e3", "kernel", KERNEL, "rangenet", 1e3), *_BEV_ROWS, *_BEAMS),
    (
        Network(
            "rangenet",
            ((1024, "street-1"),),
            "ln(0.01 + standard deviation over all pixels) of each channel at W / 8: encoder stage 3, decoder stage 4",
            128,
            layers=21,
        ),
    ),
    Bev(),
    sensor="hdl-64e-kitti",
    projection="auto",
    near=0.0,
    far=float("inf"),
    gated=(),
    samples=None,
    samples_bev=None,
    real_bev=None,
    notes=("all images of both sides count; compare scores of the same counts only",),
)

_STEPS = "Jensen-Shannon divergence, natural logarithm, of |ln r - ln r'| of neighbours in 40 logarithmic bins"
_OFF = "Jensen-Shannon divergence of metres from a point to the line through its neighbours on the ring"
STREET_2 = replace(
    STREET_1,
    name="street-2",
    rows=(
        *STREET_1.rows,
        Row("steps along a ring x1e3", "sharp-along", _STEPS, scale=1e3),
        Row("steps from beam to beam x1e3", "sharp-down", _STEPS, scale=1e3),
        Row("thickness of the ground x1e3", "sharp-ground", _OFF, scale=1e3),
        Row("thickness of walls x1e3", "sharp-walls", _OFF, scale=1e3),
    ),
    notes=(*STREET_1.notes, "the FRD does not see range noise of 0.2 m; the rows of steps and thickness do"),
)

STREET_UPSAMPLING_1 = replace(
    R2DM_UPSAMPLING,
    name="street-upsampling-1",
    source="lidarsynth: r2dm-upsampling-2024 with the classes of street-1's network, which comes with the package",
    networks=(replace(STREET_1.networks[0], layer=R2DM_UPSAMPLING.networks[0].layer, features=0),),
    notes=("the network learned synthetic streets: its IoU tells methods apart, and is not that of RangeNet-53",),
)

_PUBLISHED = (R2DM, LIDARGEN, LIDM, R2FLOW, R3DPA, DUSTY, DUSTY_SMALL, R2DM_UPSAMPLING, ILN, LIDM_RECONSTRUCTION)
PROTOCOLS: dict[str, EvaluationProtocol] = {
    p.name: p for p in (*_PUBLISHED, BEV_1, STREET_1, STREET_2, STREET_UPSAMPLING_1)
}


def get_protocol(name: str) -> EvaluationProtocol:
    """A protocol by its name. Raises ValueError that lists the names."""
    if not isinstance(name, str) or name not in PROTOCOLS:
        raise ValueError(f"expected a protocol of {', '.join(PROTOCOLS)}, found {name!r:.60}")
    return PROTOCOLS[name]
