"""The report: every part is there, its figures are the summary's, and it stands alone."""

import dataclasses
import math
import re
from collections.abc import Iterator
from html.parser import HTMLParser
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from foredrive.errors import InputError
from foredrive.metrics.protocols import PROTOCOLS
from foredrive.scene import Example
from foredrive.view import palette
from foredrive.view.example_panel import (
    ExamplePanel,
    camera_with_paths,
    comparison_picture,
    front_camera,
    panel_html,
)
from foredrive.view.hero import write_hero
from foredrive.view.loss_curves import draw_loss_curves
from foredrive.view.report import ReportData, report_html, write_report
from foredrive.view.summary_tables import full_table, image_table, number, occupancy_table, planning_tables

DASH, TIMES = "\N{EN DASH}", "\N{MULTIPLICATION SIGN}"


class Page(HTMLParser):
    """Tags with their attributes, and the text, of a page."""

    def __init__(self, html: str) -> None:
        super().__init__()
        self.tags: list[tuple[str, dict[str, str | None]]] = []
        self.open: list[str] = []
        self.cells: list[list[str]] = []
        self.text = ""
        self.feed(html)
        assert self.open == [], f"not closed: {self.open}"

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append((tag, dict(attrs)))
        if tag not in ("meta", "img", "br"):
            self.open.append(tag)
        if tag == "tr":
            self.cells.append([])
        elif tag in ("td", "th"):
            self.cells[-1].append("")

    def handle_startendtag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append((tag, dict(attrs)))

    def handle_endtag(self, tag: str) -> None:
        assert self.open.pop() == tag

    def handle_data(self, data: str) -> None:
        self.text += data
        if self.open and {"td", "th"} & set(self.open):
            self.cells[-1][-1] += data.strip()

    def row(self, title: str) -> list[str]:
        (found,) = [row[1:] for row in self.cells if row and row[0] == title]
        return found


@pytest.fixture(scope="module")
def panel(example: Example) -> ExamplePanel:
    clip = example.clip
    labels = example.occupancy.values[clip.now :, 0] > 0.5
    plan = dataclasses.replace(clip.future, xy=clip.future.xy + torch.tensor([0.0, -1.0]))
    return ExamplePanel(
        title="street <1>",
        example=example,
        occupied=labels.roll(1, dims=2),
        rendered=clip.images[clip.now].float() / 255,
        volume=torch.randn(6, *labels.shape[1:], generator=torch.Generator().manual_seed(0)),
        plan=plan,
    )


def summary() -> dict[str, float | int | str | None]:
    figures: dict[str, float | int | str | None] = {
        "failed": 2,
        "planning.stand_still.failed": 0,
        "command_source": "mixed",
        "command_source.route": 5,
        "command_source.driven_future": 3,
        "command_source.none": 0,
        "wall_s": 12.0,
        "image.psnr_db": 19.25,
        "image.ssim": 0.5,
        "image.future_500ms.psnr_db": 18.0,
        "image.future_500ms.ssim": None,
    }
    for scope, iou in (("", 0.6), ("above_ground.", 0.3)):
        for when in ("now", "future_500ms"):
            for metric in ("iou", "precision", "recall"):
                figures[f"occupancy.{scope}{metric}_{when}"] = iou
                figures[f"occupancy.{scope}{metric}_{when}.best_constant"] = 0.12
    for offset, agent in enumerate(("", "stand_still.")):
        for protocol in PROTOCOLS:
            for when in ("1s", "2s", "3s", "avg"):
                figures[f"planning.{agent}{protocol}.l2_{when}_m"] = 1.0 + offset
                figures[f"planning.{agent}{protocol}.collision_{when}_pct"] = math.nan
            figures[f"planning.{agent}{protocol}.frames_counted"] = 7
            figures[f"planning.{agent}{protocol}.frames_invalid"] = 1
    return figures


@pytest.fixture(scope="module")
def report(panel: ExamplePanel) -> ReportData:
    lines = [{"step": i, "loss": 3.0 / i, "occ": 2.0 / i, "perc": 0.0} for i in range(1, 40)]
    return ReportData(
        title="A run & more",
        command="foredrive evaluate runs/a",
        commit="abc123",
        machine="2 cores",
        date="2026-11-21",
        summary=summary(),
        losses={"pretrain": lines, "finetune": []},
        panels=[panel],
        notes=["one log of five seconds"],
    )


@pytest.fixture(scope="module")
def html(report: ReportData) -> str:
    return report_html(report)


def references(html: str) -> Iterator[str]:
    """Everything a browser could fetch."""
    for _, attributes in Page(html).tags:
        for name in ("src", "href", "xlink:href", "srcset", "data", "action", "poster"):
            if attributes.get(name):
                yield str(attributes[name])
    yield from re.findall(r"url\(['\"]?([^)'\"]+)", html)
    yield from re.findall(r"@import\s+['\"]?([^'\";]+)", html)


def test_the_page_loads_nothing_and_runs_nothing(html: str) -> None:
    found = list(references(html))
    assert len(found) > 20
    assert all(item.startswith(("data:image/", "#")) for item in found), found
    assert not {"script", "link", "iframe", "object"} & {tag for tag, _ in Page(html).tags}


def test_every_part_is_there_and_text_is_escaped(html: str) -> None:
    page = Page(html)
    for part in (
        "A run & more",
        "foredrive evaluate runs/a",
        "abc123",
        "2 cores",
        "2026-11-21",
        "one log of five seconds",
        "Planning, open loop",
        "Occupancy on voxels the lidar knows",
        "Rendered images",
        "Losses",
        "street <1>",
        "Predicted occupancy",
        "Volume: PCA",
        "driven future (green) and plan (red)",
        "Imagined occupancy at +0.5 s",
    ):
        assert part in page.text, part


def test_failures_and_leaking_commands_are_said_first_and_loudly(html: str) -> None:
    start = html[: html.index("In short")]
    assert "<strong>Failed items of this model: 2.</strong>" in start
    assert "<strong>Commands taken from the driven future, which leaks" in start
    assert "stand still" not in start  # no failures, nothing to say


def test_six_cameras_stand_beside_six_rendered_views(panel: ExamplePanel) -> None:
    alts = [attributes["alt"] for tag, attributes in Page(panel_html(panel)).tags if tag == "img"]
    order = ["front_left", "front", "front_right", "back_left", "back", "back_right"]
    start = alts.index("front_left")
    assert alts[start : start + 12] == order * 2


def test_pictures_are_images_of_the_size_they_state(html: str) -> None:
    import base64
    import io

    images = [attributes for tag, attributes in Page(html).tags if tag == "img"]
    for attributes in images:
        data = base64.b64decode(str(attributes["src"]).partition(",")[2])
        with Image.open(io.BytesIO(data)) as picture:
            assert picture.size == (int(str(attributes["width"])), int(str(attributes["height"])))
            assert np.ptp(np.asarray(picture.convert("L"))) > 20  # not blank


def test_planning_tables_show_every_protocol_beside_its_baselines() -> None:
    page = Page(planning_tables(summary()))
    for title in ("ST-P3", "UniAD", "VAD", "SparseDrive", "BEV-Planner"):
        assert page.text.count(title) >= 2
    models = [row[1:] for row in page.cells if row[0] == "this model"]
    assert models[0] == ["1.00", DASH] * 5
    assert models[1] == ["1.00"] * 4 + [DASH] * 4 + ["7", "1", DASH]
    assert len(models) == 1 + len(PROTOCOLS)
    assert planning_tables(summary()).count('class="best"') == 5 + 4 * 5  # L2 only, the model's


def test_occupancy_is_shown_against_the_best_constant() -> None:
    page = Page(occupancy_table(summary()))
    assert [row[1:] for row in page.cells if row[0] == "now"] == [
        ["0.600"] * 3 + ["0.120"] * 3 + [f"5.00 {TIMES}"],
        ["0.300"] * 3 + ["0.120"] * 3 + [f"2.50 {TIMES}"],
    ]
    assert len([row for row in page.cells if row[0] == "+500 ms"]) == 2


def test_image_quality_now_and_later() -> None:
    page = Page(image_table(summary()))
    assert page.row("now") == ["19.25", "0.500"]
    assert page.row("+500 ms") == ["18.00", DASH]


def test_an_empty_summary_makes_no_tables() -> None:
    assert planning_tables({}) == occupancy_table({}) == image_table({}) == ""


@pytest.mark.parametrize(
    ("value", "text"),
    [(1.23456, "1.235"), (math.nan, "&ndash;"), (None, "&ndash;"), (7, "7"), ("a<b", "a&lt;b")],
)
def test_figures_as_text(value: float | int | str | None, text: str) -> None:
    assert number(value) == text


def test_the_full_table_has_every_key() -> None:
    page = Page(full_table(summary()))
    assert {row[0] for row in page.cells} == {"key", *summary()}


def test_curves_leave_out_what_is_no_loss_and_what_never_was_positive() -> None:
    lines = [{"step": i, "loss": 1.0 / i, "perc": 0.0, "step_s": 0.1} for i in range(1, 9)]
    svg = draw_loss_curves({"pretrain": lines, "finetune": []})
    assert "pretrain" in svg
    assert ">loss<" in svg
    assert "perc" not in svg
    assert "step_s" not in svg
    assert "finetune" not in svg
    assert "currentColor" in svg
    assert draw_loss_curves({"finetune": []}) == ""


def test_a_log_without_images_gets_its_panel(panel: ExamplePanel) -> None:
    clip = panel.example.clip
    dark = dataclasses.replace(clip, image_valid=torch.zeros_like(clip.image_valid))
    blind = dataclasses.replace(panel, example=dataclasses.replace(panel.example, clip=dark))
    assert "no camera images" in panel_html(blind)
    assert front_camera(dark) is None


def test_the_front_camera_looks_ahead_and_shows_both_paths(panel: ExamplePanel) -> None:
    clip = panel.example.clip
    front = front_camera(clip)
    assert front is not None
    assert clip.rig.names[front] == "front"
    image = camera_with_paths(clip, front, panel.plan, 480).astype(int)
    for colour in (palette.EXPERT, palette.PLAN):
        close = np.abs(image - palette.rgb255(colour)).sum(-1) < 80
        assert close.sum() > 100
    green = np.abs(image - palette.rgb255(palette.EXPERT)).sum(-1) < 80
    red = np.abs(image - palette.rgb255(palette.PLAN)).sum(-1) < 80
    assert np.nonzero(red)[1].mean() > np.nonzero(green)[1].mean()  # planned 1 m to the right


def test_the_comparison_shows_the_key_frame_that_is_asked_for(panel: ExamplePanel) -> None:
    perfect = panel.example.occupancy.values[panel.example.clip.now :, 0] > 0.5
    right = dataclasses.replace(panel, occupied=perfect)
    swapped = dataclasses.replace(panel, occupied=perfect.flip(0))
    wrong = [palette.rgb255(palette.FALSE_POSITIVE), palette.rgb255(palette.FALSE_NEGATIVE)]
    for step in (0, 1):
        flawless, confused = (comparison_picture(p, step).reshape(-1, 3) for p in (right, swapped))
        assert not (flawless[:, None] == np.array(wrong)).all(-1).any()
        assert (confused[:, None] == np.array(wrong)).all(-1).any(0).all()


def test_the_report_is_written_whole(report: ReportData, tmp_path: Path) -> None:
    write_report(tmp_path / "report.html", dataclasses.replace(report, panels=[]))
    assert (tmp_path / "report.html").read_text(encoding="utf-8").endswith("</html>\n")
    assert [p.name for p in tmp_path.iterdir()] == ["report.html"]


def test_the_hero_needs_images(panel: ExamplePanel, tmp_path: Path) -> None:
    write_hero(tmp_path / "hero.png", panel)
    with Image.open(tmp_path / "hero.png") as picture:
        assert picture.width > 1500
    clip = panel.example.clip
    dark = dataclasses.replace(clip, image_valid=torch.zeros_like(clip.image_valid))
    blind = dataclasses.replace(panel, example=dataclasses.replace(panel.example, clip=dark))
    with pytest.raises(InputError, match="no camera images"):
        write_hero(tmp_path / "none.png", blind)
