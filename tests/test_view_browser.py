"""The viewer's page in a real browser: what it draws, what it asks for, how fast it is. Skipped without Chromium."""

import base64
import io
import json
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
from chromium import Page, chromium, find
from PIL import Image

from lidarsynth.files.formats import write
from lidarsynth.lidar.scan import Scan
from lidarsynth.pictures.colours import height_colours, label_colours, range_colours, reflectance_colours
from lidarsynth.verbs.inputs import Loaded, Reading
from lidarsynth.viewer.packing import Shown
from lidarsynth.viewer.page import Entry, write_page
from lidarsynth.viewer.pairs import compared
from lidarsynth.viewer.series import Stream
from lidarsynth.viewer.server import Show, address, serve

PROGRAM = find()
NONE = "no Chromium here: install the package chromium, or name one in CHROMIUM"
pytestmark = [pytest.mark.skipif(PROGRAM is None, reason=NONE), pytest.mark.slow]
BOX = {"kind": "car", "centre": [10.0, -3.0, -1.0], "size": [4.2, 1.8, 1.5], "yaw": 0.3, "velocity": [3.0, 0.0, 0.0]}


def street(points: int = 60_000, seed: int = 0) -> Scan:
    """A road between two walls, ring after ring, with every field that has a colour."""
    rng = np.random.default_rng(seed)
    ring = np.sort(rng.integers(0, 64, points))
    azimuth, elevation = rng.uniform(-np.pi, np.pi, points), np.radians(3 - 27 * ring / 63)
    way = np.minimum(8 / np.maximum(np.abs(np.sin(azimuth)), 0.1), 1.7 / np.tan(np.maximum(-elevation, 0.02)))
    xyz = np.stack([way * np.cos(azimuth), way * np.sin(azimuth), way * np.tan(elevation)], axis=1).astype(np.float32)
    extra = {"new": rng.integers(0, 2, points).astype(np.uint8), "confidence": rng.random(points).astype(np.float32)}
    return Scan(xyz, rng.random(points).astype(np.float32), ring=ring, label=rng.integers(0, 20, points), extra=extra)


@pytest.fixture(scope="module")
def page(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Page]:
    pytest.importorskip("websockets", reason="websockets, which drives Chromium, is not installed: lidarsynth[test]")
    assert PROGRAM is not None
    with chromium(PROGRAM, tmp_path_factory.mktemp("profile")) as opened:
        yield opened


@pytest.fixture(scope="module")
def alone(tmp_path_factory: pytest.TempPathFactory) -> str:
    """A file of two stops, the first with a scan before and after."""
    path = tmp_path_factory.mktemp("view") / "view.html"
    before = street()[np.asarray(street().ring) % 4 == 0]
    pair = {"after": Shown(street(), (BOX,)), "before": Shown(before)}
    write_page(path, "street", [Entry("first", pair), Entry("second", {"after": Shown(street(seed=1))})])
    return path.as_uri()


REACHED = """new Promise((done) => {{
    const wait = () => state.number === {} ? done() : setTimeout(wait, 20);
    wait();
}})"""
AS_OPENED = """(state.word = 'range', state.hidden = {}, state.pin = null, $('least').value = 0,
    $('boxes').checked = $('rings').checked = true, $('strips').hidden = false,
    look('behind'), show(''), go(0, 0))"""


def opened(page: Page, url: str, width: int = 1280) -> None:
    """The page as it is when it was just opened; opening it again takes a second."""
    if page.shown == (url, width, 800):
        page.run(AS_OPENED)
        page.settle()
    else:
        page.open(url, width, 800)


def within_a_pixel(mask: np.ndarray) -> np.ndarray:
    """(H, W) bool: True also beside what is True."""
    wide = np.pad(mask, 1)
    return np.any(
        [wide[1 + dy :, 1 + dx :][: len(mask), : mask.shape[1]] for dy in (-1, 0, 1) for dx in (-1, 0, 1)], axis=0
    )


def pixels(png: bytes) -> np.ndarray:
    return np.asarray(Image.open(io.BytesIO(png)).convert("RGB")).astype(int)


def colours_in(picture: np.ndarray) -> int:
    return len(np.unique(picture @ (1, 256, 65536)))


def drawn(page: Page) -> np.ndarray:
    """(H, W) bool: what of the view's own canvas is no background."""
    link = page.run("motion.paint(1), $('scene').toDataURL('image/png')")
    return np.abs(pixels(base64.b64decode(link.partition(",")[2])) - (11, 13, 17)).sum(axis=2) > 40


@pytest.mark.parametrize("who", ["card", "splat"])
def test_points_are_on_the_screen(page: Page, alone: str, who: str):
    page.open(f"{alone}#{who}")
    assert page.run("scene.constructor.name").lower() == who
    picture = pixels(page.picture())
    assert picture.shape == (800, 1280, 3)
    assert colours_in(picture) > 500, "a page of points has many colours"
    assert 0.02 < drawn(page).mean() < 0.9
    assert page.errors == []


def test_sizes_are_not_cut_off_on_a_screen_of_fine_pixels(page: Page, alone: str):
    """Two pixels for one of the page's: a point was at most 6 of them, wherever the slider stood."""
    page.open(f"{alone}#card")
    shares = []
    for fine in (1, 2):
        page.call("Emulation.setDeviceMetricsOverride", width=1280, height=800, deviceScaleFactor=fine, mobile=False)
        page.settle()
        page.run("$('size').value = 4, camera.distance = 10")
        shares.append(drawn(page).mean())
    page.shown = ("", 0, 0)
    assert shares[1] == pytest.approx(shares[0], rel=0.1)


def test_both_ways_of_drawing_draw_the_same(page: Page, alone: str):
    views = []
    for who in ("card", "splat"):
        page.open(f"{alone}#{who}")
        page.run("$('boxes').checked = $('rings').checked = false, relines()")
        views.append(drawn(page))
    card, splat = views
    for one, other in ((card, splat), (splat, card)):
        assert (one & within_a_pixel(other)).sum() > 0.995 * one.sum(), "points are rounded to pixels, not moved"


def test_the_file_asks_for_nothing(page: Page, alone: str):
    page.requests.clear()
    page.open(alone)
    page.key("ArrowRight")
    page.run("go(1)")
    assert {url.partition(":")[0] for url in page.requests} <= {"file", "data", "about"}
    assert page.errors == []


def test_the_switch_changes_the_scan_and_not_the_view(page: Page, alone: str):
    opened(page, alone)
    assert page.run("[...$('versions').children].map((b) => b.textContent)") == ["after", "before"]
    camera, count = page.run("[...camera.matrix(1)]"), page.run("state.scan.n")
    after = drawn(page)
    page.key("b")
    page.run("go(0, 1)")  # answers when that scan is shown
    before = drawn(page)
    assert page.run("state.version") == 1
    assert page.run("state.scan.n") < count / 3
    assert page.run("[...camera.matrix(1)]") == camera
    assert before.sum() < 0.7 * after.sum()
    assert page.run("$('versions').querySelector('[aria-pressed=true]').textContent") == "before"


def test_colours_are_those_of_the_pictures(page: Page, alone: str):
    opened(page, alone)
    far, low, high = (page.run(f"colourings.{of}") for of in ("range.high", "height.low", "height.high"))
    xyz = np.array(page.run("[...state.scan.xyz.subarray(0, 3000)]")).reshape(-1, 3)
    fields = {name: np.array(page.run(f"[...state.scan.fields.{name}.subarray(0, 1000)]"))
              for name in ("reflectance", "label")}  # fmt: skip
    expected = {
        "range": range_colours(np.linalg.norm(xyz, axis=1), far),
        "height": height_colours(xyz[:, 2], low, high),
        "reflectance": reflectance_colours(fields["reflectance"] / 255),
        "label": label_colours(fields["label"]),
    }
    for word, colours in expected.items():
        rgba = page.run(f"[...coloursOf(state.scan, '{word}', colourings.{word}).subarray(0, 4000)]")
        found = np.array(rgba).reshape(-1, 4)
        assert (found[:, 3] == 255).all()
        assert np.abs(found[:, :3] - colours.astype(int)).max() <= 6, word  # 256 shades of 1024


def test_a_strip_shows_the_nearest_point_of_each_pixel(page: Page, alone: str):
    opened(page, alone)
    found = np.array(page.run("[...state.pixels]"))
    strip = page.run("state.scan.strip")
    xyz = np.array(page.run("[...state.scan.xyz]")).reshape(-1, 3)
    row = np.array(page.run("[...state.scan.row]"))
    width = strip["width"]
    column = np.floor((1 - np.arctan2(xyz[:, 1], xyz[:, 0]) / np.pi) / 2 * width).astype(int) % width
    distance = np.linalg.norm(xyz, axis=1)
    best = np.full(strip["height"] * width, np.inf)
    np.minimum.at(best, row * width + column, distance)
    assert ((found >= 0) == np.isfinite(best)).mean() > 0.999, "rounding may move a point by a column"
    here = (found >= 0) & np.isfinite(best)
    assert (np.abs(distance[found[here]] - best[here]) < 1e-4).mean() > 0.999


def test_the_first_passes_are_an_even_sample(page: Page, alone: str):
    """What is drawn while the camera moves: an eighth of the points has an eighth of each beam's."""
    opened(page, alone)
    row = np.array(page.run("[...state.scan.row]"))
    share = np.bincount(row[: len(row) // 8], minlength=64) / np.bincount(row, minlength=64)
    assert np.abs(share - 1 / 8).max() < 0.01
    assert sorted(page.run("[...state.scan.row]")) == sorted(street().ring.tolist())  # type: ignore[union-attr]


def test_boxes_are_drawn_and_can_be_taken_away(page: Page, alone: str):
    opened(page, alone)
    page.run("$('rings').checked = false, $('boxes').checked = true, relines()")
    edges = page.run("scene.lines.length ? scene.lines[0].xyz.length / 6 : 0")
    assert edges == 12 + 1 + 1  # edges, the front, the way it moves
    corners = np.array(page.run("[...scene.lines[0].xyz]")).reshape(-1, 3)[:24]
    np.testing.assert_allclose(corners.mean(axis=0), BOX["centre"], atol=1e-5)
    turned = (corners - BOX["centre"]) @ [[np.cos(0.3), -np.sin(0.3), 0], [np.sin(0.3), np.cos(0.3), 0], [0, 0, 1]]
    np.testing.assert_allclose(np.abs(turned), np.tile(np.array(BOX["size"]) / 2, (24, 1)), atol=1e-5)
    page.run("$('boxes').checked = false, relines()")
    assert page.run("scene.lines.length") == 0


def test_what_is_pointed_at_is_told(page: Page, alone: str):
    opened(page, alone)
    page.run("$('strips').hidden = true")
    page.settle()
    page.run("camera.target = [...state.scan.xyz.subarray(21, 24)], box = $('scene').getBoundingClientRect(), 0")
    middle = "box.left + box.width / 2, box.top + box.height / 2"
    found = page.run(f"[...state.scan.xyz.subarray(3 * pick($('scene'), {middle})).subarray(0, 3)]")
    wanted = page.run("[...state.scan.xyz.subarray(21, 24)]")
    eye = page.run("camera.eye()")
    assert np.linalg.norm(np.subtract(found, eye)) <= np.linalg.norm(np.subtract(wanted, eye)) * 1.05
    assert "range" in page.run("told(7)")


def test_the_pointer_turns_moves_and_nears(page: Page, alone: str):
    opened(page, alone)
    turn, distance = page.run("camera.turn"), page.run("camera.distance")
    page.drag((700, 300), (800, 300))
    assert page.run("camera.turn") == pytest.approx(turn - 0.6)
    assert page.run("camera.distance") == distance and page.run("camera.target[1]") == 0
    look = np.array(page.run("camera.target"))
    page.drag((700, 300), (720, 310), "right")
    moved = np.array(page.run("camera.target")) - look
    assert 0.1 < np.linalg.norm(moved) < 5 and page.run("camera.turn") == pytest.approx(turn - 0.6)
    page.wheel((700, 300), -100)
    assert page.run("camera.distance") < distance
    assert page.run("$('views').querySelectorAll('[aria-pressed=true]').length") == 0


def place_of(page: Page, element: str) -> tuple[float, float]:
    """The middle of an element on the screen."""
    box = page.run(f"(({{ x, y, width, height }}) => [x, y, width, height])({element}.getBoundingClientRect())")
    return box[0] + box[2] / 2, box[1] + box[3] / 2


def test_a_click_on_a_class_hides_it_and_with_shift_the_others(page: Page, alone: str):
    """From the view, the strips and what is pointed at; the next scan, and the colours, have it so too."""
    opened(page, alone)
    page.key("4")
    names = "[...$('legend').querySelectorAll('.class')].map((row) => row.querySelector('span').textContent)"
    label, first = np.array(page.run("[...state.scan.fields.label]")), page.run(names)[0]
    number = page.run(f"colourings.label.classes.findIndex(([name]) => name === '{first}')")
    page.click(place_of(page, "$('legend').children[0]"))
    left = int((label != number).sum())
    assert f"{len(label):,} points to" in (facts := page.run("$('facts').textContent"))
    assert f", {left:,} of them drawn" in facts
    assert page.run("(scene.xyz ?? []).length") == 3 * left
    assert not (label[[i for i in page.run("[...state.pixels]") if i >= 0]] == number).any()
    page.run("$('rings').checked = $('boxes').checked = false, relines()")
    page.click(place_of(page, "$('legend').children[0]"), shift=True)  # it alone
    assert page.run("scene.xyz.length / 3") == len(label) - left
    hit = page.run("Array.from({ length: 200 }, (_, k) => pick($('scene'), 300 + 4 * k, 430)).filter((i) => i !== null)"
                   ".map((i) => state.scan.fields.label[i])")  # fmt: skip
    assert hit and set(hit) == {number}
    page.key("1")
    page.run("go(1)")
    assert page.run("scene.xyz.length / 3 === state.scan.fields.label.reduce((n, c) => n + (c === "
                    f"{number}), 0)") is True  # fmt: skip
    page.key("4")
    row = f"[...$('legend').children].find((one) => one.textContent.startsWith('{first}'))"
    page.click(place_of(page, row), shift=True)  # all again
    assert "drawn" not in page.run("$('facts').textContent") and page.run("state.drawn") is None


def test_what_is_too_unsure_is_hidden(page: Page, alone: str):
    opened(page, alone)
    assert page.run("$('with-least').hidden") is False
    page.run("$('least').value = 0.6, $('least').oninput()")
    confidence = np.array(page.run("[...state.scan.fields.confidence]"))
    assert page.run("scene.xyz.length / 3") == (confidence >= 0.6 * 255).sum()
    assert page.run("$('panel').scrollWidth <= $('panel').clientWidth") is True
    page.run("go(0, 1)")
    assert page.run("$('with-least').hidden") is False


def test_a_click_pins_a_point_to_measure_from(page: Page, alone: str):
    opened(page, alone)
    page.click((700, 450))
    pin = page.run("state.pin")
    assert page.run("$('readout').textContent").endswith("pinned") and page.run("$('pin').hidden") is False
    other = page.run("[...state.scan.xyz.subarray(300, 303)]")
    assert page.run("told(100)").endswith(f"{np.linalg.norm(np.subtract(other, pin)):.2f} m from the pin")
    page.drag((600, 300), (640, 300))
    page.click((760, 480), times=2)  # turns about a point, and pins none
    assert page.run("state.pin") == pin
    page.run("go(1)")
    assert page.run("state.pin") == pin and "from the pin" in page.run("told(100)")
    page.key("Escape")
    assert page.run("state.pin") is None and page.run("$('pin').hidden") is True


def test_of_what_the_slider_passes_only_some_is_read(page: Page, tmp_path: Path):
    for i in range(40):
        write(tmp_path / f"{i:06d}.ply", street(500, i))
    with on_a_server(page, Show("folder", compared([tmp_path], None, Reading()))):
        page.requests.clear()
        page.run("for (let i = 1; i < 40; i++) { $('slider').value = i; $('slider').oninput(); }")
        page.run(REACHED.format(39))
        assert page.run("[$('where').textContent, $('slider').value]") == ["40 / 40", "39"]
        assert sum("/scan/" in url for url in page.requests) < 6


def test_a_page_without_its_server_says_so(page: Page, tmp_path: Path):
    for i in range(3):
        write(tmp_path / f"{i}.ply", street(2_000, i))
    gone = {"latency": 0, "downloadThroughput": -1, "uploadThroughput": -1}
    with on_a_server(page, Show("folder", compared([tmp_path], None, Reading()))):
        page.call("Network.emulateNetworkConditions", offline=True, **gone)
        page.run("go(2)")
        page.call("Network.emulateNetworkConditions", offline=False, **gone)
        assert page.run("$('message').textContent").startswith("expected an answer of lidarsynth view, found none")
        page.errors.clear()  # the browser's own words
        page.run("go(2)")
        assert page.run("$('message').hidden") is True


@pytest.mark.parametrize(("script", "told"), [
    ("delete globalThis.DecompressionStream", "expected a browser of 2023 or later"),
    ("", ""),
])  # fmt: skip
def test_an_old_browser_is_told_so(page: Page, alone: str, script: str, told: str):
    added = page.call("Page.addScriptToEvaluateOnNewDocument", source=script)
    page.open(alone)
    page.call("Page.removeScriptToEvaluateOnNewDocument", identifier=added["identifier"])
    assert page.run("$('message').textContent").startswith(told) and page.run("$('message').hidden") is (not told)


def test_points_are_counted_in_words(page: Page, tmp_path: Path):
    for count, told in ((0, "no points"), (1, "1 point to"), (2, "2 points to")):
        write_page(tmp_path / "view.html", "few", [Entry("few", {"scan": Shown(street()[:count])})])
        page.open(f"{(tmp_path / 'view.html').as_uri()}?{count}")
        assert page.run("$('facts').textContent").startswith(told)


def test_play_goes_round(page: Page, alone: str):
    opened(page, alone)
    page.key(" ")
    page.run(
        "new Promise((done) => { const wait = () => state.number === 1 ? done() : setTimeout(wait, 20); wait(); })"
    )
    page.run(
        "new Promise((done) => { const wait = () => state.number === 0 ? done() : setTimeout(wait, 20); wait(); })"
    )
    page.key(" ")
    assert page.run("state.playing") == 0


def test_a_narrow_window_has_everything_within_it(page: Page, alone: str):
    opened(page, alone, 400)
    assert page.run("document.documentElement.scrollWidth") <= 400
    outside = "((r) => r.right > 400 || r.left < 0)(b.getBoundingClientRect())"
    assert page.run(f"[...document.querySelectorAll('button')].filter((b) => b.offsetParent && {outside}).length") == 0
    assert page.run("$('panel').open") is False


def test_the_screenshot_holds_view_and_strips(page: Page, alone: str):
    opened(page, alone)
    shot = pixels(base64.b64decode(page.run("pictureNow().toDataURL('image/png')").partition(",")[2]))
    view = page.run("$('scene').height")
    assert shot.shape == (view + 2 * 78, 1280, 3)
    assert colours_in(shot[view:]) > 100
    assert (shot[80:95, 16:256].max(axis=2) > 100).mean() > 0.5, "the legend"


def test_the_screenshot_has_the_distances_of_the_rings(page: Page, alone: str):
    opened(page, alone)
    shots = []
    for text in ("", "10 m"):
        page.run(f"motion.paint(1), [...$('distances').children].forEach((one) => one.textContent = '{text}')")
        shots.append(pixels(base64.b64decode(page.run("pictureNow().toDataURL('image/png')").partition(",")[2])))
    page.run("$('distances').replaceChildren()")  # which are made anew
    x, y = np.argwhere((shots[0] != shots[1]).any(-1)).mean(0)[::-1]
    assert abs(x - 640) < 20 and 0 < y < page.run("$('scene').height")


def test_the_screenshot_says_what_a_scan_lacks(page: Page, tmp_path: Path):
    path, bare = tmp_path / "view.html", Scan(street().xyz)
    write_page(path, "pair", [Entry("pair", {"after": Shown(street()), "before": Shown(bare)})])
    page.open(path.as_uri())
    page.run("$('words').querySelector('[data-word=confidence]').click()")
    page.run("go(0, 1)")
    assert page.run("$('legend').textContent") == "this scan has no confidence"
    shot = pixels(base64.b64decode(page.run("pictureNow().toDataURL('image/png')").partition(",")[2]))
    page.run("$('legend').replaceChildren(made('p', 'note', ''))")
    empty = pixels(base64.b64decode(page.run("pictureNow().toDataURL('image/png')").partition(",")[2]))
    assert (shot[80:98, 16:240] != empty[80:98, 16:240]).any(), "the words stand where the legend would"


@contextmanager
def on_a_server(page: Page, show: Show) -> Iterator[None]:
    """The page open on a server of these scans; it must not have complained."""
    with serve(show) as server:
        thread = threading.Thread(target=server.serve_forever, daemon=True)
        thread.start()
        try:
            page.open(address(server, show))
            yield
        finally:
            server.shutdown()
            thread.join()
    assert page.errors == []


def test_of_the_scan_before_nothing_stays(page: Page, tmp_path: Path):
    """Neither what was read off it, nor, where the next one is broken, anything of it."""
    write(tmp_path / "0.ply", street(20_000))
    (tmp_path / "0.json").write_text(json.dumps({"boxes": [BOX]}))
    write(tmp_path / "1.ply", street(20_000, 1))
    (tmp_path / "2.ply").write_bytes(b"ply\nnot at all")
    with on_a_server(page, Show("folder", compared([tmp_path], None, Reading()))):
        page.run("pointAt(7)")
        assert "range" in page.run("$('readout').textContent")
        page.run("go(1)")
        assert page.run("$('readout').textContent") == ""
        page.run("go(0)")
        page.run("go(2)")
        page.settle()
        assert page.run("$('where').textContent") == "3 / 3" and page.run("state.scan") is None
        assert drawn(page).sum() == 0 and page.run("scene.lines.length") == 0
        for of in ("facts", "words", "unit", "legend", "notes", "strips"):
            assert page.run(f"$('{of}').textContent + $('{of}').childElementCount") == "0", of
        assert page.run("$('with-boxes').hidden") is True
        page.key("p")
        page.run("go(0)")
        assert drawn(page).sum() > 1000 and page.run("$('strips').childElementCount") == 3


def test_a_first_scan_that_is_broken_is_no_fault_of_the_page(page: Page, tmp_path: Path):
    (tmp_path / "0.ply").write_bytes(b"ply\nnot at all")
    write(tmp_path / "1.ply", street(20_000))
    with on_a_server(page, Show("folder", compared([tmp_path], None, Reading()))):
        assert page.run("$('with-boxes').hidden") is True
        for wanted in (0, 1):
            page.run("$('rings').click()")
            assert page.run("scene.lines.length") == wanted


def test_the_title_stands_while_the_first_scan_is_read(page: Page, alone: str):
    opened(page, alone)
    early = "const read = Source.prototype.load; Source.prototype.load = () => new Promise(() => {});"
    page.run(f"(() => {{ {early} $('title').textContent = ''; begin(); Source.prototype.load = read; }})()")
    assert page.run("$('title').textContent") == "street · first"
    page.shown = ("", 0, 0)  # to be opened anew


def test_nobody_goes_back_from_the_first_to_a_last_that_is_not_known(page: Page):
    items = [StandIn(f"item {k}", Path(), street(2_000, k)) for k in range(3)]
    stream = Stream(lambda mark, number: ((0, item) for item in items), None)
    with on_a_server(page, Show("capture", {"capture": stream})):
        asked = "((before) => { step(-1); return state.wanted !== before; })(state.wanted)"
        assert page.run(asked) is False
        page.run("go(3)")  # behind the last
        assert page.run("source.count") == 3 and page.run("state.number") == 0 and page.run(asked) is True


@dataclass(frozen=True)
class StandIn:
    """A turn of a capture."""

    name: str
    path: Path
    scan: Scan

    def read(self) -> Loaded:
        """The scan."""
        return Loaded(self.scan, {}, 0)


def test_a_folder_from_the_server(page: Page, tmp_path: Path):
    for i in range(3):
        write(tmp_path / f"{i:06d}.ply", street(20_000, i))
        (tmp_path / f"{i:06d}.json").write_text(json.dumps({"boxes": [BOX] * i}))
    (tmp_path / "000002.ply").write_bytes(b"ply\nnot at all")
    show = Show("folder", compared([tmp_path], None, Reading()))
    page.requests.clear()
    with serve(show) as server:
        thread = threading.Thread(target=server.serve_forever, daemon=True)
        thread.start()
        page.open(address(server, show))
        assert page.run("$('where').textContent") == "1 / 3"
        page.run("go(1)")
        assert page.run("state.scan.boxes.length") == 1
        assert all(url.startswith((address(server, show), "data:", "about:")) for url in page.requests)
        assert page.errors == []
        page.run("go(2)")  # broken: said on the page, and the others stay
        assert "000002.ply: expected" in page.run("$('message').textContent")
        page.run("go(0)")
        assert page.run("$('message').hidden") is True
        server.shutdown()
        thread.join()
    assert page.errors == []


def test_frames_a_second(page: Page, tmp_path: Path):
    """200,000 points, each drawn in each frame, and as many as there is time for; `-s` shows what it was here."""
    path = tmp_path / "view.html"
    write_page(path, "many", [Entry("many", {"scan": Shown(street(200_000))})])
    page.open(path.as_uri())
    assert page.run("scene.constructor.name") == "Splat", "this browser was told to leave a graphics card alone"
    page.run("motion.measure(1)")
    before = page.cpu_seconds()
    rate = page.run("motion.measure(2)")
    cost = 1000 * (page.cpu_seconds() - before) / 2
    moving, share = page.run("motion.measure(2, null)"), page.run("motion.whole()")
    print(f"\n200,000 points at 1280 x 800, no graphics card: {rate:.0f} frames a second of all points, {cost:.1f} ms "
          f"of processor time each; {moving:.0f} while the camera moves, {share:.0%} of the points")  # fmt: skip
    assert rate > 3, "even on a machine that does much else"
