"""The file of a training's losses."""

import json
import time
from pathlib import Path

from torch import Tensor

from foredrive.files import atomic_path, naming


class MetricsLog:
    """The file metrics.jsonl, one line per step. Lines after the resumed step are dropped.

    `step_s` is the time since the step before, `cpu_s` this process's CPU time, without its data workers.
    """

    def __init__(self, path: Path, done: int) -> None:
        # Steps after the checkpoint are repeated, so their lines are written again
        kept = [line for line in read_metrics(path) if line["step"] <= done]
        with atomic_path(path) as temporary:
            temporary.write_text("".join(json.dumps(line) + "\n" for line in kept))
        self.path = path
        self._wall_s, self._cpu_s = time.perf_counter(), time.process_time()

    def add(self, step: int, losses: dict[str, Tensor]) -> None:
        """Write the losses of one finished step."""
        wall_s, cpu_s = time.perf_counter(), time.process_time()
        took = {"step_s": round(wall_s - self._wall_s, 4), "cpu_s": round(cpu_s - self._cpu_s, 4)}
        line = {"step": step, **{name: value.item() for name, value in losses.items()}}
        with naming(self.path), self.path.open("a") as file:
            file.write(json.dumps({**line, **took}) + "\n")
        self._wall_s, self._cpu_s = wall_s, cpu_s


def read_metrics(path: Path) -> list[dict[str, float | int]]:
    """Return the lines of a metrics file. A last line cut off by a crash is left out."""
    lines = []
    for text in path.read_text().splitlines() if path.exists() else []:
        try:
            lines.append(json.loads(text))
        except json.JSONDecodeError:
            break
    return lines
