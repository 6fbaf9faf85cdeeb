"""A page for a log, in 3-D and over time, with a run's predictions."""

import threading
import time

from foredrive.view import palette
from foredrive.view.log_frames import LogFrames
from foredrive.view.model_panel import ModelPanel
from foredrive.view.page import Page
from foredrive.view.scene_nodes import show_boxes, show_cameras, show_ego, show_lidar, show_map, show_path

LAYERS = ("lidar", "boxes", "map", "cameras", "driven")
PLAY_PERIOD_S = 0.1


class Viewer(Page):
    """A page with a slider for time and, with a run, a slider for the imagined time ahead.

    All nodes are in the ego frame at the time shown, so that the view follows the vehicle. The server runs in
    its own threads until `close`.

    Args:
        frames: the shown log, with or without a run.
        host, port: address of the page; if the port is taken, the next free one.

    Raises:
        InputError: the page cannot be served there.
    """

    def __init__(self, frames: LogFrames, host: str, port: int) -> None:
        self.frames = frames
        self._drawing, self._drawn, self._closed = threading.Lock(), -1, False
        super().__init__(frames.name, host, port)
        show_ego(self.server.scene)
        self._add_controls()
        self.model = None if frames.predictor is None else ModelPanel(self.server, frames)
        self.show(0)

    def show(self, index: int) -> None:
        """Go to a frame of the log."""
        self._frame.value = index
        self._draw()

    def play(self) -> None:
        """Step through the log while "play" is ticked on the page; never return."""
        while True:
            time.sleep(PLAY_PERIOD_S)
            if self._play.value:
                self.show((self._frame.value + 1) % len(self.frames))

    def close(self) -> None:
        """Stop serving. Frames that browsers have requested are not drawn."""
        with self._drawing:
            self._closed = True
        super().close()

    def _add_controls(self) -> None:
        gui, count = self.server.gui, len(self.frames)
        with gui.add_folder("Time"):
            self._clock = gui.add_markdown("")
            self._frame = gui.add_slider("frame", 0, max(count - 1, 1), 1, 0, disabled=count == 1)
            step = gui.add_button_group("step", ("back", "on"))
            self._play = gui.add_checkbox("play", False)
        with gui.add_folder("Log"):
            self.layers = {name: gui.add_checkbox(name, True) for name in LAYERS}
        self._frame.on_update(lambda _: self._draw())
        step.on_click(lambda _: self._step(1 if step.value == "on" else -1))
        for box in self.layers.values():
            box.on_update(lambda _: self._show_layers())

    def _step(self, change: int) -> None:
        self.show(min(max(self._frame.value + change, 0), len(self.frames) - 1))

    def _draw(self) -> None:
        """Draw the newest requested frame; frames requested in between are dropped."""
        with self._drawing:
            # Read with the lock held: while one frame was drawn, the slider may have moved on several times
            index = min(self._frame.value, len(self.frames) - 1)
            if index == self._drawn or self._closed:
                return
            clip = self.frames.clip(index)
            with self.server.atomic():
                self._clock.content = f"**{self.frames.t_s[index]:.2f} s** of {self.frames.duration_s:.2f} s"
                for show in (show_lidar, show_boxes, show_map, show_cameras):
                    show(self.server.scene, clip)
                show_path(self.server.scene, "driven", clip.future, palette.EXPERT)
                self._show_layers()
            if self.model is not None:
                self.model.show(index)
            self._drawn = index

    def _show_layers(self) -> None:
        for name, box in self.layers.items():
            node = self.server.scene.get_handle_by_name(f"/{name}")
            if node is not None:
                node.visible = box.value
