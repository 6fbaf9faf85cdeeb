"""Draws pages in the browser with Chromium: `python docs/draw/pages.py model LOG` or `… reconstructed RUN`.

`model` draws docs/nemo_viewer.jpg, nemo_features.jpg and nemo_rendered.jpg: what the NeMo of the package
sees in runs/demo-quick/logs/town_test/Town05_seed7 of `foredrive demo --quick`. `reconstructed` draws
docs/reconstructed_view.jpg, of runs/demo/reconstructed of `foredrive demo`.
"""

import base64
import contextlib
import json
import re
import subprocess
import sys
import tempfile
import time
import urllib.request
from collections.abc import Iterator
from io import BytesIO
from pathlib import Path
from typing import Any

import viser
from PIL import Image
from websockets.sync.client import ClientConnection, connect

from foredrive.data import find_logs
from foredrive.runs import open_run
from foredrive.runs.reconstruction.reconstruction_run import open_reconstruction
from foredrive.runs.shipped import run_folder
from foredrive.view.log_frames import CAMERA_WIDTH_PX, LogFrames
from foredrive.view.page import START_EYE_M, START_TARGET_M, Page
from foredrive.view.reconstruction_viewer import ReconstructedViewer
from foredrive.view.viewer import Viewer

DOCS = Path(__file__).parents[1]
FLAGS = (
    "--headless",
    "--no-sandbox",
    "--use-angle=swiftshader",  # WebGL without a GPU
    "--enable-unsafe-swiftshader",
    "--disable-quic",
    "--no-first-run",
    "--disable-background-networking",
    "--disable-component-update",
    "--disable-sync",
    "--remote-debugging-port=0",
)
SIZE = {"width": 1400, "height": 860, "deviceScaleFactor": 1, "mobile": False}
DRAWN_S = 20.0
"""Time after which a browser without a GPU has drawn a scene, s."""
AT_S = 4.0


class Browser:
    """Chromium with one page, driven by its DevTools protocol."""

    def __init__(self, socket: ClientConnection) -> None:
        self._socket, self._calls = socket, 0

    def call(self, method: str, **params: object) -> dict[str, Any]:
        """Call a method of the protocol; return its result."""
        self._calls += 1
        self._socket.send(json.dumps({"id": self._calls, "method": method, "params": params}))
        while True:
            answer = json.loads(self._socket.recv())
            if answer.get("id") == self._calls:
                return dict(answer["result"])

    def open(self, page: Page) -> viser.ClientHandle:
        """Open a page; return its client once the scene is drawn."""
        self.call("Emulation.setDeviceMetricsOverride", **SIZE)
        self.call("Page.navigate", url=page.url)
        while not (clients := page.server.get_clients()):
            time.sleep(0.2)
        time.sleep(DRAWN_S)
        return next(iter(clients.values()))

    def press(self, title: str) -> None:
        """Press the button with a title."""
        buttons = "[...document.querySelectorAll('button')]"
        self.call(
            "Runtime.evaluate", expression=f"{buttons}.find(b => b.innerText.includes('{title}')).click()"
        )

    def write(self, path: Path) -> None:
        """Write what the page shows, once it is drawn."""
        time.sleep(DRAWN_S)
        shown = self.call("Page.captureScreenshot")["data"]
        Image.open(BytesIO(base64.b64decode(shown))).convert("RGB").save(path, quality=85)


@contextlib.contextmanager
def browser() -> Iterator[Browser]:
    """Run Chromium with an empty profile."""
    with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as profile:
        command = ["chromium", *FLAGS, f"--user-data-dir={profile}", "about:blank"]
        program = subprocess.Popen(command, stderr=subprocess.PIPE, text=True)
        try:
            assert program.stderr is not None
            port = next(
                found[1] for line in program.stderr if (found := re.search(r"127\.0\.0\.1:(\d+)", line))
            )
            with urllib.request.urlopen(f"http://127.0.0.1:{port}/json/list") as listed:
                (page,) = [each for each in json.load(listed) if each["type"] == "page"]
            with connect(page["webSocketDebuggerUrl"], max_size=None) as socket:
                yield Browser(socket)
        finally:
            program.terminate()
            program.wait()


def draw_model(log: Path, chromium: Browser) -> None:
    """Draw a log with what the model of the package sees in it."""
    with tempfile.TemporaryDirectory() as folder:
        run = open_run(run_folder(Path("embedded:nemo_town"), Path(folder)))
        frames = LogFrames(find_logs(log)[0], CAMERA_WIDTH_PX, run)
        viewer = Viewer(frames, "127.0.0.1", 0)
        with contextlib.closing(viewer):
            assert viewer.model is not None
            viewer.show(frames.nearest(AT_S))
            client = chromium.open(viewer)
            chromium.write(DOCS / "nemo_viewer.jpg")

            client.camera.position, client.camera.look_at = (-8.0, 0.0, 4.0), (12.0, 0.0, 0.5)
            time.sleep(DRAWN_S)
            chromium.press("Render from here")
            time.sleep(DRAWN_S)
            client.camera.position, client.camera.look_at = (-13.0, 3.0, 6.0), (0.0, 0.0, 2.0)
            chromium.write(DOCS / "nemo_rendered.jpg")

            viewer.server.scene.remove_by_name("/rendered")
            client.camera.position, client.camera.look_at = START_EYE_M, START_TARGET_M
            for layer in ("lidar", "cameras", "map"):
                viewer.layers[layer].value = False
            viewer.model.colour_by.value = "features"
            viewer.model.min_height_m.value = viewer.model.spec.lower_m[2]
            chromium.write(DOCS / "nemo_features.jpg")


def draw_reconstructed(folder: Path, chromium: Browser) -> None:
    """Draw a reconstructed log from behind and above, from where no camera was."""
    page = ReconstructedViewer(open_reconstruction(folder), [], Path("edits.json"), "127.0.0.1", 0)
    with contextlib.closing(page):
        page.show(AT_S)
        client = chromium.open(page)
        client.camera.position, client.camera.look_at = (-16.0, 7.0, 10.0), (8.0, 0.0, 0.0)
        chromium.write(DOCS / "reconstructed_view.jpg")


DRAWN_BY = {"model": draw_model, "reconstructed": draw_reconstructed}


def main() -> None:
    """Draw what is named."""
    name, folder = sys.argv[1:]
    with browser() as chromium:
        DRAWN_BY[name](Path(folder), chromium)


if __name__ == "__main__":
    main()
