"""RangeNet: parity with the published programs, official archives and bad ones, post-processing."""

import io
import json
import tarfile
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch
from torch import Tensor

from lidarsynth.metrics.knn import knn_labels, smooth_labels
from lidarsynth.networks.rangenet import RangeNet, frechet_features, frechet_positions
from lidarsynth.networks.rangenet_archive import read_rangenet
from lidarsynth.networks.tensors import load_weights


def assert_net(actual: Tensor, expected: Tensor) -> None:
    torch.testing.assert_close(actual, expected, atol=1e-4 * expected.abs().max().item(), rtol=0)


def small(seed: int = 0, **options) -> RangeNet:
    with torch.random.fork_rng():
        torch.manual_seed(seed)
        return RangeNet(21, width=4, **options).eval()


def scans(count: int = 3, width: int = 64) -> tuple[Tensor, Tensor]:
    generator = torch.Generator().manual_seed(0)
    mask = torch.rand(count, 1, 8, width, generator=generator) < 0.8
    return 20 * torch.randn(count, 5, 8, width, generator=generator), mask


@torch.no_grad()
def test_the_official_archive_gives_the_reference_output(shared: Path, fixture_tensors):
    tensors = fixture_tensors("rangenet/darknet21_io")
    network = read_rangenet(shared / "fixtures/rangenet/darknet21.tar.gz")
    image, mask, columns = tensors["image"], tensors["mask"], tensors["columns"]
    x = network.network_input(image, mask)
    maps = network.features(x)
    logits = network.head(maps)
    assert_net(x[..., columns], tensors["network_input_cols"])
    assert_net(maps[:, :, ::8][..., columns], tensors["decoder_cols"])
    assert_net(logits[..., columns], tensors["logits_cols"])
    assert (logits.argmax(1) == tensors["argmax"]).float().mean() >= 0.999
    positions = frechet_positions(64, 1024)
    assert torch.equal(positions, tensors["feature_index"])
    assert_net(maps.flatten(1)[:, positions], tensors["feature_lidargen"])


@pytest.mark.parametrize("layers", [21, 53])
def test_names_shapes_and_counts_are_the_published_ones(layers, reference: Path):
    published = json.loads((reference / f"fixtures/rangenet/darknet{layers}_keys.json").read_text())
    with torch.device("meta"):
        network = RangeNet(layers)
    parts = (network.backbone, network.decoder, network.head)
    for module, (name, expected) in zip(parts, published.items(), strict=True):
        assert {key: list(value.shape) for key, value in module.state_dict().items()} == expected, name
    assert sum(p.numel() for p in network.parameters()) == {21: 24_712_980, 53: 50_377_364}[layers]


def test_positions_are_the_published_ones(fixture_tensors):
    for name, expected in fixture_tensors("rangenet/feature_indices").items():
        assert torch.equal(frechet_positions(64, int(name[1:])), expected.long())
    assert frechet_positions(64, 1024)[:3].tolist() == [1615835, 1764005, 169803]


def test_features_do_not_depend_on_the_batch():
    network, (image, mask) = small(), scans()
    together = frechet_features(network, image, mask, count=100)
    assert together.shape == (3, 100)
    for i in range(3):
        torch.testing.assert_close(frechet_features(network, image[i : i + 1], mask[i], count=100), together[i : i + 1])
    with pytest.raises(ValueError, match="evaluation mode"):
        frechet_features(network.train(), image, mask)


def test_pixels_without_a_return_are_zero_whatever_they_hold():
    network, (image, mask) = small(), scans()
    x = network.network_input(torch.where(mask, image, torch.nan), mask[:, 0].to(torch.uint8))
    assert torch.equal(x, network.network_input(image, mask))
    assert not x[~mask.expand_as(x)].any()


def test_it_learns_and_the_skips_carry_no_gradient():
    network, (image, mask) = small(dropout=0.0), scans(2)
    x = network.network_input(image, mask).requires_grad_()
    label = (image[:, 1] > 0).long() * 9
    optimiser = torch.optim.Adam(network.train().parameters(), 0.01)
    losses = []
    for _ in range(15):
        optimiser.zero_grad()
        loss = torch.nn.functional.cross_entropy(network(x), label)
        loss.backward()
        optimiser.step()
        losses.append(loss.item())
    assert losses[-1] < 0.5 * losses[0]
    assert not any(skip.requires_grad for skip in network.backbone(x)[1])


def archive(path: Path, members: dict[str, bytes | tarfile.TarInfo]) -> Path:
    with tarfile.open(path, "w:gz") as tar:
        for name, content in members.items():
            member = content if isinstance(content, tarfile.TarInfo) else tarfile.TarInfo(name)
            member.size = len(content) if isinstance(content, bytes) else 0
            tar.addfile(member, io.BytesIO(content) if isinstance(content, bytes) else None)
    return path


def link(name: str) -> tarfile.TarInfo:
    member = tarfile.TarInfo(name)
    member.type, member.linkname = tarfile.SYMTYPE, "/etc/passwd"
    return member


class Payload:
    def __reduce__(self):
        return Path.touch, (Path("pwned"),)


def saved(state: object) -> bytes:
    buffer = io.BytesIO()
    torch.save(state, buffer, _use_new_zipfile_serialization=False)
    return buffer.getvalue()


CONFIG = b"""
backbone: {OS: 32, input_depth: {range: true, xyz: true, remission: true}, extra: {layers: 21}}
dataset: {sensor: {img_means: [12.12, 10.88, 0.23, -1.04, 0.21], img_stds: [12.32, 11.47, 6.91, 0.86, 0.16]}}
"""
WHOLE = {f"net/{name}": b"" for name in ("backbone", "segmentation_decoder", "segmentation_head")}
WHOLE |= {"net/arch_cfg.yaml": CONFIG}


@pytest.mark.parametrize(
    ("members", "message"),
    [
        ({"net/backbone": b""}, "found no segmentation_decoder, segmentation_head, arch_cfg.yaml"),
        ({**WHOLE, "../../backbone": b""}, "found '../../backbone'"),
        ({"/etc/backbone": b"", **WHOLE}, "found '/?etc/backbone'"),
        ({**WHOLE, "net/backbone": link("net/backbone")}, "found 'net/backbone' .a link"),
        ({**WHOLE, "other/backbone": b""}, "found 'other/backbone' .again"),
        ({**WHOLE, "net/arch_cfg.yaml": b"a: [1"}, "arch_cfg.yaml: expected YAML"),
        ({**WHOLE, "net/arch_cfg.yaml": b"!!python/object/apply:os.getcwd []"}, "expected YAML"),
        ({**WHOLE, "net/arch_cfg.yaml": b"a: " + b" " * (1 << 20)}, "at most 1048576 bytes"),
        ({**WHOLE, "net/arch_cfg.yaml": CONFIG.replace(b"32,", b"16,", 1)}, "OS 32 .* found .16,"),
        ({**WHOLE, "net/arch_cfg.yaml": CONFIG.replace(b"21", b"22")}, "21 or 53 layers, found 22"),
        ({**WHOLE, "net/arch_cfg.yaml": CONFIG.replace(b"0.16]", b"wide]")}, "as numbers"),
        (WHOLE, "backbone: expected weights, found a damaged"),
        ({**WHOLE, "net/backbone": saved({"a": Payload()})}, "backbone: expected weights, found a damaged or unsafe"),
        ({**WHOLE, "net/backbone": saved([1])}, "backbone: expected tensors by name, found list"),
        (
            {**WHOLE, "net/backbone": saved({"a": torch.ones(1)})},
            "backbone: expected conv1.weight .32, 5, 3, 3., found none",
        ),
    ],
)
def test_archives_that_cannot_be_trusted(members: dict, message: str, tmp_path: Path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    path = archive(tmp_path / "net.tar.gz", members)
    with pytest.raises(ValueError, match=message) as caught:
        read_rangenet(path)
    assert "\n" not in str(caught.value)
    assert [p.name for p in tmp_path.iterdir()] == ["net.tar.gz"], "nothing is unpacked or run"


@pytest.mark.parametrize(
    "damage", [lambda b: b[: len(b) // 2], lambda b: b"", lambda b: b"<html>" + b, lambda b: b[:300]]
)
def test_damaged_archives(damage: Callable, tmp_path: Path):
    path = archive(tmp_path / "net.tar.gz", {**WHOLE, "net/x": np.random.default_rng(0).bytes(1 << 16)})
    path.write_bytes(damage(path.read_bytes()))
    with pytest.raises(ValueError, match=r"expected (a RangeNet archive|the files)"):
        read_rangenet(path)
    with pytest.raises(ValueError, match="No such file"):
        read_rangenet(tmp_path / "missing.tar.gz")
    with pytest.raises(ValueError, match="found no backbone"):
        read_rangenet(tmp_path)


def test_weights_may_lack_the_counters_but_nothing_else():
    network, other = small(0), small(1)
    state = {k: v for k, v in other.state_dict().items() if "num_batches_tracked" not in k}
    load_weights(network, state, "here", counters=True)
    torch.testing.assert_close(network.state_dict(), other.state_dict())
    for change, message in (
        ({"head.1.bias": torch.ones(3)}, r"here: expected head.1.bias \(20,\), found \(3,\)"),
        ({"more": torch.ones(3)}, r"here: expected more not to be there, found \(3,\); 1 tensors"),
    ):
        with pytest.raises(ValueError, match=message):
            load_weights(network, state | change, "here", counters=True)


def test_knn_equals_the_reference_exactly(fixture_tensors):
    t = fixture_tensors("rangenet/knn")
    for size in (3, 5):
        points = knn_labels(t["proj_range"], t["proj_argmax"], t["py"], t["px"], t["unproj_range"], k=size, search=size)
        assert torch.equal(points, t[f"original.k{size}.search{size}"])
        image = smooth_labels(t["proj_range"], t["proj_argmax"], k=size, search=size)
        assert torch.equal(image, t[f"simplified.k{size}.search{size}"])


def test_knn_keeps_a_uniform_surface_and_separates_by_range():
    ranges, labels = torch.full((8, 8), 10.0), torch.full((8, 8), 13)
    ranges[:, 4:], labels[:, 4:] = 30.0, 9
    row, column = torch.meshgrid(torch.arange(8), torch.arange(8), indexing="ij")
    points = knn_labels(ranges, labels, row.flatten(), column.flatten(), ranges.flatten())
    assert torch.equal(points.view(8, 8), labels)
    behind = knn_labels(ranges, labels, torch.tensor([4]), torch.tensor([3]), torch.tensor([30.2]))
    assert behind.tolist() == [9], "a point behind the edge takes the label of what lies as far"
    with pytest.raises(ValueError, match="search 4 and k 5"):
        knn_labels(ranges, labels, row, column, ranges, search=4)


@pytest.mark.parametrize(("row", "column"), [(3, 16), (3, 20), (3, -1), (8, 3), (-1, 3)])
def test_points_outside_the_image_have_no_pixel_there(row: int, column: int):
    ranges, labels = torch.full((8, 16), 10.0), torch.full((8, 16), 13)
    inside = knn_labels(ranges, labels, torch.tensor([7]), torch.tensor([15]), torch.tensor([10.0]))
    assert inside.tolist() == [13]
    with pytest.raises(ValueError, match=f"expected pixels of an image of 8 x 16, found row {row}, column {column}$"):
        knn_labels(ranges, labels, torch.tensor([7, row]), torch.tensor([15, column]), torch.tensor([10.0, 10.0]))
    nothing = torch.zeros(0)
    assert knn_labels(ranges, labels, nothing, nothing, nothing).shape == (0,)


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: RangeNet(50), "21 or 53 layers, found 50"),
        (lambda: RangeNet(21, width=4, stds=(1, 1, 0, 1, 1)), "5 positive stds"),
        (lambda: small()(torch.ones(1, 5, 8, 40)), r"multiple of 32, got \(1, 5, 8, 40\)"),
        (lambda: small().network_input(torch.ones(1, 4, 8, 32), torch.ones(1, 1, 8, 32)), r"got \(1, 4, 8, 32\)"),
    ],
)
def test_errors_say_both_sides(call: Callable, message: str):
    with pytest.raises(ValueError, match=message):
        call()
