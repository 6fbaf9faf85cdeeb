"""Figures on disk and on the screen."""

import json
import math
import re
from collections.abc import Mapping, Sequence
from pathlib import Path

from rich import box
from rich.console import Console
from rich.table import Table

from foredrive.errors import InputError
from foredrive.files import atomic_path
from foredrive.metrics.protocols import HORIZON_NAMES, PROTOCOLS

Value = float | int | str | None
TABLE_COLUMNS = 120
_RIVAL = re.compile(r"occupancy\.iou_\w+\.(\w+)")


def write_json(path: Path, content: object) -> None:
    """Write JSON whole or not at all; NaN and infinity, which JSON does not have, become null."""
    with atomic_path(path) as temporary:
        temporary.write_text(json.dumps(_finite(content), indent=2, allow_nan=False) + "\n")


def write_summary(path: Path, summary: Mapping[str, Value]) -> None:
    """Write a flat summary (dotted keys) as JSON, keys in their given order."""
    write_json(path, dict(summary))


def read_summary(path: Path) -> dict[str, Value]:
    """Read what `write_summary` wrote."""
    try:
        summary = json.loads(path.read_text())
    except (OSError, ValueError) as error:
        raise InputError(f"{path}: not a summary that can be read") from error
    if not isinstance(summary, dict):
        raise InputError(f"{path}: not a summary: expected a JSON object")
    return summary


def _finite(value: object) -> object:
    if isinstance(value, Mapping):
        return {key: _finite(entry) for key, entry in value.items()}
    if isinstance(value, (list, tuple)):
        return [_finite(entry) for entry in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


def planning_table(summary: Mapping[str, Value], model: str = "model") -> Table:
    """Every protocol side by side, the model and its baselines under each."""
    whens = (*HORIZON_NAMES, "avg")
    table = _table("Open-loop planning", ("protocol", "planner"))
    for title in ("L2, m", "col., %"):
        for when in whens:
            table.add_column(f"{title if when == whens[0] else ''}\n{when}", justify="right", no_wrap=True)
    table.add_column("frames\ncounted", justify="right", no_wrap=True)
    table.add_column("\ninvalid", justify="right", no_wrap=True)
    for key, protocol in PROTOCOLS.items():
        prefixes = _planners(summary, key, model)
        for i, (name, prefix) in enumerate(prefixes.items()):
            l2 = [_show(summary.get(f"{prefix}.l2_{h}_m"), 2) for h in whens]
            collisions = [
                _show(summary.get(f"{prefix}.collision_{h}_pct"), 2) for h in (*HORIZON_NAMES, "avg")
            ]
            table.add_row(
                protocol.title if i == 0 else "",
                name,
                *l2,
                *collisions,
                _show(summary.get(f"{prefix}.frames_counted"), 0),
                _show(summary.get(f"{prefix}.frames_invalid"), 0),
                end_section=i == len(prefixes) - 1,
            )
    return table


def _planners(summary: Mapping[str, Value], protocol: str, model: str) -> dict[str, str]:
    """Planner names and the prefixes of their keys under a protocol, the model first."""
    found: dict[str, str] = {}
    ending = f".{protocol}.l2_avg_m"
    for key in summary:
        if key.startswith("planning.") and key.endswith(ending):
            prefix = key.removesuffix(".l2_avg_m")
            name = prefix.removeprefix("planning.").removesuffix(protocol).rstrip(".")
            found[name.replace("_", " ") or model] = prefix
    return dict(sorted(found.items(), key=lambda entry: entry[0] != model))


def _table(title: str, words: Sequence[str]) -> Table:
    """A table without vertical lines, and its columns of words."""
    table = Table(title=title, title_justify="left", header_style="bold", box=box.SIMPLE_HEAD)
    for word in words:
        table.add_column(word, no_wrap=True, vertical="bottom")
    return table


def occupancy_table(summary: Mapping[str, Value]) -> Table:
    """Occupancy now and in the future, beside whatever else was judged by its IoU."""
    table = _table("Occupancy on known voxels", ("voxels", "when"))
    rivals = rivals_of_occupancy(summary)
    for title in ("IoU", *rivals.values(), "precision", "recall"):
        table.add_column(title, justify="right")
    for scope, title in (("", "all"), ("above_ground.", "above ground")):
        prefix = f"occupancy.{scope}"
        names = [key.removeprefix(f"{prefix}iou_") for key in summary if key.startswith(f"{prefix}iou_")]
        for i, name in enumerate(names := [name for name in names if "." not in name]):
            table.add_row(
                title if i == 0 else "",
                name.replace("future_", "in "),
                _show(summary.get(f"{prefix}iou_{name}"), 3),
                *(_show(summary.get(f"{prefix}iou_{name}.{rival}"), 3) for rival in rivals),
                _show(summary.get(f"{prefix}precision_{name}"), 3),
                _show(summary.get(f"{prefix}recall_{name}"), 3),
                end_section=i == len(names) - 1,
            )
    return table


def rivals_of_occupancy(summary: Mapping[str, Value]) -> dict[str, str]:
    """What stands beside the IoU of a model's occupancy, with titles: the best constant, copies of its own
    present, futures by chance."""
    found = [match[1] for key in summary if (match := _RIVAL.fullmatch(key))]
    return {name: name.replace("_", " ") for name in dict.fromkeys(found) if "threshold" not in name}


def print_summary(summary: Mapping[str, Value], console: Console, model: str = "model") -> None:
    """Print what a person wants to see of a summary. A console of less than 120 columns is widened."""
    console.width = max(console.width, TABLE_COLUMNS)
    if any(key.startswith("occupancy.") for key in summary):
        console.print(occupancy_table(summary))
    if any(key.startswith("planning.") for key in summary):
        console.print(planning_table(summary, model))
    if "image.psnr_db" in summary:
        console.print(
            f"rendered images: PSNR {_show(summary['image.psnr_db'], 1)} dB, "
            f"SSIM {_show(summary.get('image.ssim'), 3)}"
        )
    console.print(
        f"{_show(summary.get('items'), 0)} clips, {_show(summary.get('failed'), 0)} failed; "
        f"commands from: {summary.get('command_source', 'none')}; "
        f"peak memory {_show(summary.get('peak_rss_gib'), 2)} GiB, {_show(summary.get('wall_s'), 0)} s"
    )


def _show(value: Value, digits: int) -> str:
    if isinstance(value, str):
        return value
    return "-" if value is None or not math.isfinite(value) else f"{value:.{digits}f}"
