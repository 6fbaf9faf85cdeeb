"""The report: every part is there, its figures are the summary's, and it stands alone."""

import dataclasses
import math
from pathlib import Path

import numpy as np
import pytest
import torch
from html_pages import EVIL, Page, assert_harmless
from PIL import Image

from foredrive.errors import InputError
from foredrive.runs import ExamplePrediction
from foredrive.scene import Example
from foredrive.tasks.evaluation import metrics
from foredrive.tasks.metric import EvaluationContext, Shown
from foredrive.tasks.planning.protocols import PROTOCOLS
from foredrive.view import palette
from foredrive.view.example_panel import (
    camera_with_paths,
    comparison_picture,
    draw_example,
    front_camera,
)
from foredrive.view.html import Provenance
from foredrive.view.overview import Overview, write_overview
from foredrive.view.run_report import RunReport, draw_loss_curves, write_run_report
from foredrive.view.summary_tables import (
    full_table,
    image_table,
    occupancy_table,
    planning_overview,
    planning_table,
    task_table,
)
from foredrive.view.table import Cell, Table, number

DASH, TIMES = "\N{EN DASH}", "\N{MULTIPLICATION SIGN}"


@pytest.fixture(scope="module")
def panel(example: Example) -> ExamplePrediction:
    clip = example.clip
    labels = example.occupancy.values[clip.now :, 0] > 0.5
    plan = dataclasses.replace(clip.future, xy=clip.future.xy + torch.tensor([0.0, -1.0]))
    return ExamplePrediction(
        example=dataclasses.replace(example, key=("street <1>@1577836802250000",)),
        occupied=labels.roll(1, dims=2),
        rendered=clip.images[clip.now].float() / 255,
        volume=torch.randn(6, *labels.shape[1:], generator=torch.Generator().manual_seed(0)),
        plan=plan,
    )


def summary() -> dict[str, float | int | str | None]:
    figures: dict[str, float | int | str | None] = {
        "items": 8,
        "failed": 2,
        "planning.stand_still.failed": 0,
        "clips.stride_s": 0.5,
        "clips.past_s": 1.0,
        "clips.future_s": 3.0,
        "clips.left_out.past": 2,
        "clips.left_out.future": 6,
        "clips.left_out.gap": 0,
        "clips.left_out.unseen": 1,
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
def report(panel: ExamplePrediction) -> RunReport:
    lines = [{"step": i, "loss": 3.0 / i, "occ": 2.0 / i, "perc": 0.0} for i in range(1, 40)]
    return RunReport(
        title="A run & more",
        provenance=Provenance("foredrive evaluate runs/a", "abc123", "2 cores", "2026-11-21"),
        summary=summary(),
        losses={"pretrain": lines, "finetune": []},
        examples=[panel],
        notes=["one log of five seconds"],
    )


@pytest.fixture(scope="module")
def html(report: RunReport, tmp_path_factory: pytest.TempPathFactory) -> str:
    path = tmp_path_factory.mktemp("report") / "report.html"
    write_run_report(path, report)
    return path.read_text()


def cells_of(table: Table | None) -> list[list[str]]:
    """A table's rows as text."""
    assert table is not None
    return [
        [
            number(cell.value if isinstance(cell, Cell) else cell, column.digits)
            for cell, column in zip(row.cells, table.columns, strict=True)
        ]
        for section in table.sections
        for row in section.rows
    ]


def best_of(table: Table | None) -> int:
    """How many cells are marked."""
    assert table is not None
    rows = [row for section in table.sections for row in section.rows]
    return sum(isinstance(cell, Cell) and cell.mark == "best" for row in rows for cell in row.cells)


def test_the_page_loads_nothing_and_runs_nothing(html: str) -> None:
    found = Page(html).references()
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
        "Occupancy on known voxels",
        "Rendered images",
        "Losses",
        "street <1> at 2020-01-01 00:00:02.25 UTC",
        "Predicted occupancy",
        "Volume: PCA",
        "driven future (green) and plan (red)",
        "Imagined occupancy at +0.5 s",
    ):
        assert part in page.text, part


def test_names_from_outside_run_nothing(report: RunReport, panel: ExamplePrediction, tmp_path: Path) -> None:
    example = panel.example
    rig = dataclasses.replace(example.clip.rig, names=(EVIL,) * len(example.clip.rig.names))
    clip = dataclasses.replace(example.clip, rig=rig)
    figures = {"planning.uniad.l2_avg_m": 1.0, f"planning.{EVIL}.failed": 3, EVIL: EVIL}
    evil = RunReport(
        title=EVIL,
        provenance=Provenance(EVIL, EVIL, EVIL, EVIL),
        summary=figures,
        losses={EVIL: [{"step": 1, EVIL: 2.0}]},
        examples=[
            dataclasses.replace(panel, example=dataclasses.replace(example, clip=clip, key=(f"{EVIL}@0",)))
        ],
        notes=[EVIL],
    )
    write_run_report(tmp_path / "report.html", evil)
    # title, heading, provenance, failures, note, key and value, stage and loss, example, front and 12 cameras
    assert_harmless((tmp_path / "report.html").read_text(), times=2 + 4 + 1 + 1 + 2 + 2 + 1 + 1 + 12)


def test_failures_and_leaking_commands_are_said_first_and_loudly(html: str) -> None:
    start = html[: html.index("Main metrics")]
    left_out = "2 without 1.0 s before them, 6 without 3.0 s after them, 1 without image and sweep"
    assert f"Judged: 8 clips, one every 0.50 s; times left out: {left_out}." in start
    assert "<strong>Failed clips of this model: 2.</strong>" in start
    assert "<strong>Commands from the driven future, which leaks" in start
    assert "stand still" not in start  # no failures, nothing to say


def test_six_cameras_stand_beside_six_rendered_views(panel: ExamplePrediction) -> None:
    order = ["front_left", "front", "front_right", "back_left", "back", "back_right"]
    cameras = draw_example(panel).cameras
    assert list(cameras) == ["Camera images", "Rendered from the volume"]
    assert all([shown.caption for shown in pictures] == order for pictures in cameras.values())


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
    overview, detail = planning_overview(summary()), planning_table(summary())
    assert overview is not None
    assert detail is not None
    titles = ["ST-P3", "UniAD", "VAD", "SparseDrive", "BEV-Planner"]
    assert [group for group, _ in overview.groups] == ["", *titles]
    assert [section.title for section in detail.sections] == titles
    assert cells_of(overview) == [
        ["this model", *["1.00", DASH] * 5],
        ["stand still", *["2.00", DASH] * 5],
    ]
    assert cells_of(detail)[0] == ["this model", *["1.00"] * 4, *[DASH] * 4, "7", "1", DASH]
    assert (best_of(overview), best_of(detail)) == (5, 4 * 5)  # L2 only, the model's


def test_occupancy_is_shown_against_the_occupancy_prior() -> None:
    rows = cells_of(occupancy_table(summary()))
    assert [row for row in rows if row[0] == "now"] == [
        ["now", *["0.600"] * 3, *["0.120"] * 3, f"5.00 {TIMES}"],
        ["now", *["0.300"] * 3, *["0.120"] * 3, f"2.50 {TIMES}"],
    ]
    assert len([row for row in rows if row[0] == "+500 ms"]) == 2


def test_notes_say_what_is_in_the_table() -> None:
    plain = {
        f"occupancy.{scope}iou_{when}": 0.5
        for scope in ("", "above_ground.")
        for when in ("now", "future_1s")
    }
    moving = plain | {f"occupancy.{scope}iou_now": 0.5 for scope in ("moving.", "standing.")}
    ceiling = moving | {"occupancy.iou_future_1s.ceiling": 0.75}
    for summary, said in ((plain, [False, False]), (moving, [True, False]), (ceiling, [True, True])):
        notes = " ".join(occupancy_table(summary).notes)
        assert [part in notes for part in ("Where things move", "Ceiling of true motion")] == said


def test_image_quality_now_and_later() -> None:
    assert cells_of(image_table(summary())) == [["now", "19.25", "0.500"], ["+500 ms", "18.00", DASH]]


def test_an_empty_summary_makes_no_tables() -> None:
    assert {planning_overview({}), planning_table({}), occupancy_table({}), image_table({})} == {None}


@pytest.mark.parametrize(
    ("value", "text"),
    [(1.23456, "1.235"), (math.nan, DASH), (None, DASH), (-0.0001, "0.000"), (7, "7"), ("a<b", "a<b")],
)
def test_figures_as_text(value: float | int | str | None, text: str) -> None:
    assert number(value) == text


def test_the_full_table_has_every_key() -> None:
    assert [row[0] for row in cells_of(full_table(summary()))] == sorted(summary())


def test_curves_leave_out_what_is_no_loss_and_what_never_was_positive() -> None:
    lines = [{"step": i, "loss": 1.0 / i, "perc": 0.0, "step_s": 0.1} for i in range(1, 9)]
    svg = draw_loss_curves({"pretrain": lines, "finetune": []})
    assert svg is not None
    assert "pretrain" in svg
    assert ">loss<" in svg
    assert "perc" not in svg
    assert "step_s" not in svg
    assert "finetune" not in svg
    assert "currentColor" in svg
    assert draw_loss_curves({"finetune": []}) is None


def test_a_log_without_images_gets_its_panel(
    report: RunReport, panel: ExamplePrediction, tmp_path: Path
) -> None:
    clip = panel.example.clip
    dark = dataclasses.replace(clip, image_valid=torch.zeros_like(clip.image_valid))
    blind = dataclasses.replace(panel, example=dataclasses.replace(panel.example, clip=dark))
    write_run_report(tmp_path / "report.html", dataclasses.replace(report, examples=[blind]))
    assert "no camera images" in (tmp_path / "report.html").read_text()
    assert front_camera(dark) is None


def test_the_front_camera_looks_ahead_and_shows_both_paths(panel: ExamplePrediction) -> None:
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


def test_the_comparison_shows_the_key_frame_that_is_asked_for(panel: ExamplePrediction) -> None:
    perfect = panel.example.occupancy.values[panel.example.clip.now :, 0] > 0.5
    right = dataclasses.replace(panel, occupied=perfect)
    swapped = dataclasses.replace(panel, occupied=perfect.flip(0))
    wrong = [palette.rgb255(palette.FALSE_POSITIVE), palette.rgb255(palette.FALSE_NEGATIVE)]
    for step in (0, 1):
        flawless, confused = (comparison_picture(p, step).reshape(-1, 3) for p in (right, swapped))
        assert not (flawless[:, None] == np.array(wrong)).all(-1).any()
        assert (confused[:, None] == np.array(wrong)).all(-1).any(0).all()


def test_the_report_is_written_whole(report: RunReport, tmp_path: Path) -> None:
    write_run_report(tmp_path / "report.html", dataclasses.replace(report, examples=[]))
    assert (tmp_path / "report.html").read_text(encoding="utf-8").endswith("</html>\n")
    assert [p.name for p in tmp_path.iterdir()] == ["report.html"]


def test_the_overview_needs_images(panel: ExamplePrediction, tmp_path: Path) -> None:
    write_overview(tmp_path / "overview.png", Overview.of(panel))
    with Image.open(tmp_path / "overview.png") as picture:
        assert picture.width > 1500
    clip = panel.example.clip
    dark = dataclasses.replace(clip, image_valid=torch.zeros_like(clip.image_valid))
    blind = dataclasses.replace(panel, example=dataclasses.replace(panel.example, clip=dark))
    with pytest.raises(InputError, match="no camera images"):
        write_overview(tmp_path / "none.png", Overview.of(blind))


def test_figures_of_tasks_stand_beside_their_baselines() -> None:
    """Only those that were evaluated; a baseline that is missing is a dash."""
    found = {
        "map.uniad.iou_lanes": 0.25,
        "map.uniad.iou_lanes.best_constant": 0.125,
        "motion.uniad.car.min_ade_m": 1.5,
    }
    assert cells_of(task_table(found)) == [
        ["UniAD, minADE of cars, m", "1.500", "constant velocity", DASH],
        ["UniAD, IoU of lanes", "0.250", "prior of the training logs", "0.125"],
    ]
    assert task_table({}) is None
    limited = found | {"map.uniad.iou_lanes.ceiling": 0.5}
    assert [row[4] for row in cells_of(task_table(limited))] == ["", "0.500"]


def test_a_new_metric_shows_its_main_figures_without_an_edit_here(monkeypatch: pytest.MonkeyPatch) -> None:
    class Heading:
        name, title = "heading", "Heading"
        shown = (Shown("error, rad", "error_rad", "straight_on", digits=2),)

        def __init__(self, context: EvaluationContext) -> None:
            pass

    monkeypatch.setattr(metrics, "METRICS", (*metrics.METRICS, Heading))
    table = task_table({"heading.error_rad": 0.125, "heading.error_rad.straight_on": 0.5})
    assert cells_of(table) == [["error, rad", "0.12", "straight on", "0.50"]]
    assert [section.title for section in table.sections] == ["Heading"]
