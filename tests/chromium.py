"""A headless Chromium for tests of pages, driven by its DevTools protocol; `CHROMIUM` names one that is elsewhere."""

from __future__ import annotations

import base64
import json
import os
import re
import shutil
import subprocess
import time
import urllib.request
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

NAMES = ("chromium", "chromium-browser", "google-chrome", "chrome", "chrome-headless-shell", "chromium-headless-shell")
FLAGS = ("--headless=new", "--disable-gpu", "--enable-unsafe-swiftshader", "--disable-frame-rate-limit",
         "--no-first-run", "--disable-background-networking", "--disable-dev-shm-usage", "--remote-debugging-port=0",
         "about:blank")  # fmt: skip
SECONDS = 90  # for one answer; the machine may be busy


def find() -> str | None:
    """The program, or None where there is none."""
    return os.environ.get("CHROMIUM") or next((path for name in NAMES if (path := shutil.which(name))), None)


class Page:
    """The one tab: what it was told to do, asked for and complained about."""

    def __init__(self, socket: Any, process: int):
        self.socket, self.process, self.calls = socket, process, 0
        self.errors: list[str] = []
        self.requests: list[str] = []
        self.shown = ("", 0, 0)
        for domain in ("Runtime", "Log", "Page", "Network"):
            self.call(f"{domain}.enable")

    def call(self, method: str, **params: Any) -> dict[str, Any]:
        """A method of the protocol; events on the way are noted."""
        self.calls += 1
        self.socket.send(json.dumps({"id": self.calls, "method": method, "params": params}))
        while True:
            message = json.loads(self.socket.recv(timeout=SECONDS))
            if message.get("id") == self.calls:
                assert "error" not in message, message
                return message["result"]
            self._note(message["method"], message["params"])

    def _note(self, event: str, params: dict[str, Any]) -> None:
        if event == "Network.requestWillBeSent":
            self.requests.append(params["request"]["url"])
        elif event == "Runtime.exceptionThrown":
            self.errors.append(json.dumps(params["exceptionDetails"])[:500])
        elif (event == "Log.entryAdded" and params["entry"]["level"] == "error") or (
            event == "Runtime.consoleAPICalled" and params["type"] in ("error", "assert")
        ):
            self.errors.append(json.dumps(params)[:500])

    def run(self, script: str) -> Any:
        """The value of an expression, awaited."""
        answer = self.call("Runtime.evaluate", expression=script, awaitPromise=True, returnByValue=True)
        assert "exceptionDetails" not in answer, answer["exceptionDetails"]
        return answer["result"].get("value")

    def open(self, url: str, width: int = 1280, height: int = 800) -> None:
        """Show a page of the viewer at this size; returns when its first scan is drawn."""
        self.call("Emulation.setDeviceMetricsOverride", width=width, height=height, deviceScaleFactor=1, mobile=False)
        self.call("Page.navigate", url="about:blank")
        self.call("Page.navigate", url=url)
        until = time.monotonic() + SECONDS
        while self.run("typeof ready === 'undefined' ? '' : document.readyState") != "complete":
            assert time.monotonic() < until, f"{url} was never shown"
            time.sleep(0.1)
        self.run("ready")
        self.settle()
        self.shown = (url, width, height)

    def settle(self) -> None:
        """Wait until what was asked for is drawn."""
        self.run("new Promise((done) => requestAnimationFrame(() => requestAnimationFrame(done)))")

    def key(self, name: str) -> None:
        """Press a key, and wait for what it changes."""
        for kind in ("keyDown", "keyUp"):
            self.call("Input.dispatchKeyEvent", type=kind, key=name)
        self.settle()

    def drag(self, start: tuple[int, int], end: tuple[int, int], button: str = "left") -> None:
        """Press there, move there, let go."""
        held = {"left": 1, "right": 2}[button]
        for kind, (x, y) in (("mousePressed", start), ("mouseMoved", end), ("mouseReleased", end)):
            self.call("Input.dispatchMouseEvent", type=kind, x=x, y=y, button=button, buttons=held, clickCount=1)
        self.settle()

    def click(self, at: tuple[float, float], times: int = 1, shift: bool = False) -> None:
        """Press and let go there, so many times in a row."""
        for count in range(1, times + 1):
            for kind in ("mousePressed", "mouseReleased"):
                self.call("Input.dispatchMouseEvent", type=kind, x=at[0], y=at[1], button="left", buttons=1,
                          clickCount=count, modifiers=8 * shift)  # fmt: skip
        self.settle()

    def wheel(self, at: tuple[int, int], turned: int) -> None:
        """Turn the wheel over a place."""
        self.call("Input.dispatchMouseEvent", type="mouseWheel", x=at[0], y=at[1], deltaX=0, deltaY=turned)
        self.settle()

    def cpu_seconds(self) -> float:
        """Processor time of all its processes so far, whatever else the machine does; 0 where there is no /proc."""
        total = 0
        for stat in Path("/proc").glob("[0-9]*/stat"):
            with suppress(OSError):
                fields = stat.read_text().rpartition(")")[2].split()
                total += (int(fields[11]) + int(fields[12])) * (int(fields[3]) == self.process)  # of its session
        return total / os.sysconf("SC_CLK_TCK")

    def picture(self) -> bytes:
        """What is on the screen, as PNG."""
        return base64.b64decode(self.call("Page.captureScreenshot", format="png")["data"])


@contextmanager
def chromium(program: str, profile: Path) -> Iterator[Page]:
    """A browser of its own, ended at the end. Needs the package websockets."""
    from websockets.sync.client import connect

    root = ["--no-sandbox"] if os.geteuid() == 0 else []
    command = [program, *root, f"--user-data-dir={profile}", *FLAGS]
    process = subprocess.Popen(command, stderr=subprocess.PIPE, text=True, start_new_session=True)
    try:
        assert process.stderr is not None
        port = next(m[1] for line in process.stderr if (m := re.search(r"ws://127\.0\.0\.1:(\d+)/", line)))
        with urllib.request.urlopen(f"http://127.0.0.1:{port}/json", timeout=SECONDS) as answer:
            tab = next(tab for tab in json.load(answer) if tab["type"] == "page")
        with connect(tab["webSocketDebuggerUrl"], max_size=None, open_timeout=SECONDS) as socket:
            yield Page(socket, process.pid)
    finally:
        process.terminate()
        with suppress(subprocess.TimeoutExpired):
            process.wait(20)
        process.kill()
        if process.stderr is not None:
            process.stderr.close()
