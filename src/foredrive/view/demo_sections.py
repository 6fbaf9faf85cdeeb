"""The sections of the demo's report. Each function does a step of `runs.demo` and shows its results."""

import math
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
import torch
from jaxtyping import UInt8
from PIL import Image, ImageOps

from foredrive.data.batches import stack_records
from foredrive.engine.folder import SUMMARY
from foredrive.engine.metrics_log import read_metrics
from foredrive.engine.summary import Summary, numbers, read_summary
from foredrive.runs.demo import (
    DRIVER,
    TEXTS,
    Demo,
    Driven,
    Judged,
    Reconstructed,
    drive_route,
    improve_driver,
    judge_shipped,
    reconstruct_drive,
    record_logs,
    search_logs,
    train_tiny,
)
from foredrive.runs.drive.agents import CORRIDOR, EXPERT, REPLAY
from foredrive.runs.evaluate.run import ExamplePrediction
from foredrive.runs.train.run import STAGES
from foredrive.tasks.occupancy.vehicles_metric import RANGES_M, car_columns
from foredrive.tasks.rendering.image_scores import psnr_db
from foredrive.view.contact_sheet import write_contact_sheet
from foredrive.view.demo_report import Block, Section
from foredrive.view.drive_plots import draw_drive_path, draw_timeline
from foredrive.view.drive_report import VIDEOS, threat_text, write_drive_report
from foredrive.view.example_panel import comparison_picture, labelled_voxels, predicted_voxels
from foredrive.view.hit_picture import WIDTH_PX, content_text, hit_name, hit_picture
from foredrive.view.html import MetricTile, Picture, inline_svg, picture, stored_film
from foredrive.view.image_drawing import resize, to_image
from foredrive.view.improve_report import answered, film_of, rounds_table, write_improve_report
from foredrive.view.log_frames import CAMERA_WIDTH_PX, LogFrames
from foredrive.view.log_sheet import write_log_sheet
from foredrive.view.loss_curves import draw_loss_curves
from foredrive.view.overview import Overview, write_overview
from foredrive.view.run_report import report_on_run, write_run_report
from foredrive.view.search_sheet import query_line
from foredrive.view.summary_tables import BASELINE_TITLES, PRIOR, planning_overview
from foredrive.view.table import Cell, Column, Table, number, simple_table, words

COVER_HW = (225, 400)
RECONSTRUCTION_WIDTH_PX = 512
SHOWN_VIEWS = 2
CARS = ("car_recall", "column_precision")
IOU = "occupancy.above_ground.iou_now"
L2 = "uniad.l2_avg_m"
SHIPPED_MIN = 30
"""Minutes for which the shipped model was trained."""
FILM = (
    "The drive at twice real time: what it plans (red), and what it sees: lights as rings where it would "
    "stop, road users on its route in orange. True lights are lines"
)
SHOWN_ANSWERS = 2
ONE_ROUND = (
    "One route and one round say nothing about a method: the score of one drive also changes by chance. "
    "foredrive bench improve compares ways to choose, with intervals."
)
MET_BY = {REPLAY: "drives on as recorded", CORRIDOR: "stops for what the rendered lidar sees"}


def show_recording(demo: Demo) -> Section:
    """Record the drives; show their cameras and paths, and one moment with its labels."""
    logs = record_logs(demo)
    whole_s = sum(plan.seconds for plan in demo.plans)
    sheet, moment = demo.out / "recorded.png", demo.out / "moment.png"
    captions = [plan.conditions or "by day" for plan in demo.plans]
    write_contact_sheet(sheet, list(zip(logs, captions, strict=True)))
    frames = LogFrames(logs[demo.plans.index(demo.size.test)], CAMERA_WIDTH_PX)
    index = frames.nearest(None)
    clip = frames.clip(index)
    write_log_sheet(moment, clip, f"{frames.name}    t = {frames.t_s[index]:.2f} s")
    return Section(
        f"{len(logs)} drives, {whole_s:.0f} s, with six cameras and a lidar",
        _cover(clip.images[clip.now, 0].permute(1, 2, 0).numpy()),
        [
            Block(
                figures=[_stored(sheet, "The drives: images of the front camera, and the path on the map")]
            ),
            Block(
                figures=[_stored(moment, "A moment in Town05: lidar and boxes in the images and from above")]
            ),
        ],
    )


def show_shipped(demo: Demo) -> Section:
    """Show the predictions of the shipped model in the held-out town."""
    judged = judge_shipped(demo)
    best = _fullest(judged.examples)
    write_overview(demo.out / "hero.png", Overview.of(best))
    _write_run_report(judged, demo.out / "seen" / "report.html")
    recall, precision = (number(judged.summary.get(f"vehicles.{key}_20m"), 2) for key in CARS)
    return Section(
        f"occupancy IoU {_figure(judged, IOU)} in a town that it never saw",
        _cover(predicted_voxels(best, 0)),
        [
            Block(
                tiles=[
                    *_tiles(judged),
                    MetricTile(
                        "Columns with a car that it finds, within 20 m",
                        recall,
                        "",
                        f"of the columns it predicts, {precision} are occupied",
                    ),
                ]
            ),
            Block(
                figures=[_stored(demo.out / "hero.png", "Six cameras go in; occupancy and a plan come out")]
            ),
            Block(
                "From above, beside the lidar's labels",
                "Green: hit. Orange: false alarm. Blue: miss. Black: unknown. The outline is the vehicle.",
                figures=_from_above(best),
                columns="three",
            ),
            Block(
                "Its plans under five protocols",
                plan_against_blind(judged.summary),
                table=planning_overview(judged.summary),
            ),
        ],
    )


def plan_against_blind(summary: Summary) -> str:
    """Say whether the plan is better than that of the MLP, which sees nothing; "" if one was not judged."""
    figures = numbers(summary)
    own_m, blind_m = (round(figures.get(f"planning.{who}{L2}", math.nan), 2) for who in ("", "ego_mlp."))
    if math.isnan(own_m) or math.isnan(blind_m):
        return ""
    blind = f"those of the ego-only MLP, which sees nothing, are {blind_m:.2f} m off"
    if own_m < blind_m:
        return f"By UniAD's L2 they are {own_m:.2f} m off; {blind}."
    return (
        f"By UniAD's L2 they are {own_m:.2f} m off, which is no gain: {blind}. Most of a plan of three "
        "seconds follows from the speed alone."
    )


def show_training(demo: Demo) -> Section:
    """Train a model from scratch; show its losses and predictions."""
    judged = train_tiny(demo)
    _write_run_report(judged, judged.run.folder / "report.html")
    losses = {stage: read_metrics(judged.run.folder / stage / "metrics.jsonl") for stage in STAGES}
    steps = [step for stage in losses.values() for step in stage]
    minutes = sum(float(step["step_s"]) for step in steps) / 60
    best = _fullest(judged.examples)
    seen = [
        picture(predicted_voxels(best, 0), "Predicted occupancy, coloured by height"),
        picture(labelled_voxels(best, 0), "Labels: what the lidar's beams hit"),
    ]
    prior = _figure(judged, f"{IOU}.{PRIOR}")
    return Section(
        f"{len(steps)} steps in {minutes:.1f} min: IoU {_figure(judged, IOU)}, prior {prior}",
        _cover(predicted_voxels(best, 0)),
        [
            Block(
                tiles=[
                    *_tiles(judged),
                    MetricTile("Training", f"{minutes:.1f}", "min", f"{len(steps)} steps"),
                ]
            ),
            Block("Losses", drawings=[curves] if (curves := draw_loss_curves(losses)) else []),
            Block("What more would bring, on the same drive", table=_more(demo, judged, minutes)),
            Block("What it sees in Town05", figures=seen, columns="two"),
        ],
    )


def show_drive(demo: Demo) -> Section:
    """Drive a route; show the film, the path, and the scores beside the expert's."""
    driven = drive_route(demo)
    seeing = driven[DRIVER]
    write_drive_report(seeing.folder)
    score = seeing.record.score
    return Section(
        f"driving score {seeing.record.driving_score_1_0:.0f}, {100 * score.completion:.0f} % of the route",
        _cover(_middle_frame(_film_path(seeing))),
        [
            Block(figures=[stored_film(_film_path(seeing), FILM)]),
            Block(
                table=_scores({f"the driver by sight on {seeing.name}": seeing, "the expert": driven[EXPERT]})
            ),
            Block(drawings=[inline_svg(draw(seeing.record)) for draw in (draw_drive_path, draw_timeline)]),
        ],
    )


def show_reconstruction(demo: Demo) -> Section:
    """Reconstruct a drive; show held-out images beside rendered ones, and the films of the car in the way."""
    reconstructed = reconstruct_drive(demo)
    for one in reconstructed.met.values():
        write_drive_report(one.folder)
    summary = reconstructed.scene.summary
    psnr, nearest = (number(summary.get(key), 1) for key in ("psnr_db", "nearest.psnr_db"))
    tiles = [
        MetricTile("Held-out images, PSNR", psnr, "dB", f"the nearest recorded image: {nearest} dB"),
        MetricTile("Gaussians", f"{summary['gaussians']:,}"),
        MetricTile("Training", number(summary.get("minutes"), 1), "min"),
    ]
    films = [
        stored_film(_film_path(one), f"{agent}: {MET_BY[agent]}") for agent, one in reconstructed.met.items()
    ]
    return Section(
        f"{psnr} dB on held-out images, and a car that was never there",
        _cover(_middle_frame(_film_path(reconstructed.met[CORRIDOR]))),
        [
            Block(tiles=tiles),
            Block("Recorded and rendered", figures=_held_out(reconstructed), columns="two"),
            Block("A car stands in the way", figures=films, columns="two", table=_threats(reconstructed.met)),
        ],
    )


def show_search(demo: Demo) -> Section:
    """Search the recorded drives; show the hits."""
    results = search_logs(demo)
    hits = [hit for result in results for hit in result.hits]
    return Section(
        f"{len(hits)} hits for “{next(iter(TEXTS))}” and {len(results) - 1} other queries",
        _cover(hit_picture(hits[0])[:, :WIDTH_PX]) if hits else None,
        [
            Block(
                query_line(result.query),
                "" if result.hits else "Nothing was found.",
                figures=[
                    picture(hit_picture(hit), f"{hit_name(hit)}: {content_text(hit)}") for hit in result.hits
                ],
                columns="three",
            )
            for result in results
        ],
    )


def show_improvement(demo: Demo) -> Section:
    """Do one round of the loop; show the failures, what was chosen for them, and the drives."""
    result = improve_driver(demo)
    write_improve_report(demo.out / "improved", result)
    answers = answered(result.rounds[-1])[:SHOWN_ANSWERS]
    scores = " to ".join(number(of_round.score, 0) for of_round in result.rounds)
    first = next(iter(result.rounds[0].judged))
    chosen = len(result.rounds[-1].hits)
    films = [
        stored_film(film_of(of_round, first), f"{when} the round: {first}" if chosen else first)
        for when, of_round in zip(("before", "after"), result.rounds, strict=False)
    ]
    return Section(
        f"driving score {scores}: {chosen} moments chosen" if chosen else result.ended,
        _cover(_middle_frame(film_of(result.rounds[-1], first))),
        [
            Block(text=ONE_ROUND, table=rounds_table(result)),
            *[
                Block(
                    f"{answer.caption}: the moment before it, and what was chosen for it",
                    figures=[answer.moment, *answer.chosen[:2]],
                    columns="three",
                )
                for answer in answers
            ],
            Block("The drive before and after" if chosen else "The drive", figures=films, columns="two"),
        ],
    )


def _tiles(judged: Judged) -> list[MetricTile]:
    mlp = number(judged.summary.get(f"planning.ego_mlp.{L2}"), 2)
    return [
        MetricTile(
            "Occupancy IoU now, above the ground",
            _figure(judged, IOU),
            "",
            f"{BASELINE_TITLES[PRIOR]}: {_figure(judged, f'{IOU}.{PRIOR}')}",
        ),
        MetricTile(
            "Plan, L2, UniAD's average", _figure(judged, f"planning.{L2}"), "m", f"ego-only MLP: {mlp} m"
        ),
    ]


def _figure(judged: Judged, key: str) -> str:
    return number(judged.summary.get(key), 2)


def _write_run_report(judged: Judged, path: Path) -> None:
    write_run_report(path, report_on_run(judged.run, judged.logs, judged.summary, judged.examples))


def _scores(drives: Mapping[str, Driven]) -> Table:
    columns = (
        Column(align="left"),
        Column("driving score", digits=1),
        Column("completion, %", digits=0),
        Column("time, s", digits=0),
        Column("ending", align="left"),
        Column("infractions", align="left"),
    )
    rows = []
    for title, drive in drives.items():
        record, score = drive.record, drive.record.score
        wrong = ", ".join(words(infraction.kind) for infraction in score.infractions)
        figures = (record.driving_score_1_0, 100 * score.completion, score.duration_s)
        rows.append((title, *figures, words(score.ending), wrong))
    return simple_table(columns, rows)


def _threats(met: Mapping[str, Driven]) -> Table:
    rows: list[tuple[str, Cell]] = []
    for agent, drive in met.items():
        result = drive.record.threat
        assert result is not None
        rows.append((agent, Cell(threat_text(result), "good" if result.impact_mps is None else "bad")))
    return simple_table((Column("agent", align="left"), Column("outcome", align="left")), rows)


def _fullest(examples: Sequence[ExamplePrediction]) -> ExamplePrediction:
    """Return the example with the most labelled columns of cars."""

    def cars(shown: ExamplePrediction) -> int:
        clip = shown.example.clip
        boxes, labels = clip.boxes[clip.now], shown.example.occupancy[clip.now]
        return int(car_columns(stack_records([boxes]), stack_records([labels]), RANGES_M[-1]).sum())

    return max(examples, key=cars)


def _more(demo: Demo, judged: Judged, minutes: float) -> Table:
    """Return the figures of this training beside those of the shipped model, which learned for longer."""
    shipped = read_summary(demo.out / "seen" / SUMMARY) if (demo.out / "seen" / SUMMARY).is_file() else {}
    columns = (
        Column(align="left"),
        Column("minutes of training", digits=1),
        Column("occupancy IoU, above the ground", digits=3),
        Column("plan, L2, m", digits=2),
    )
    mine, mlp = judged.summary, judged.summary.get(f"planning.ego_mlp.{L2}")
    rows = [
        ("occupancy prior and ego-only MLP", None, mine.get(f"{IOU}.{PRIOR}"), mlp),
        ("this model", minutes, mine.get(IOU), mine.get(f"planning.{L2}")),
        ("the shipped model", SHIPPED_MIN, shipped.get(IOU), shipped.get(f"planning.{L2}")),
    ]
    return simple_table(columns, rows)


def _from_above(shown: ExamplePrediction) -> list[Picture]:
    """Draw the key frames from now on: hits, false alarms and misses."""
    clip = shown.example.clip
    return [
        picture(
            comparison_picture(shown, step),
            f"Imagined, in {float(clip.t_s[clip.now + step]):.1f} s" if step else "Now",
            "png",
        )
        for step in range(len(shown.occupied))
    ]


@torch.no_grad()
def _held_out(reconstructed: Reconstructed) -> list[Picture]:
    """Draw some held-out images of the front camera, each with its rendering."""
    scene = reconstructed.scene.scene
    ahead = [view for view in reconstructed.scene.held_out.cameras if view.sensor == 0]
    pictures = []
    for place in np.linspace(0, len(ahead) - 1, min(SHOWN_VIEWS, len(ahead))).round().astype(int):
        view = ahead[place]
        assert view.image is not None
        real = view.image.float() / 255
        rgb = scene.camera(scene.graph, view.to(scene.device)).rgb.clamp(0, 1).cpu()
        quality = float(psnr_db(rgb[None], real[None], torch.ones(1, *view.size_hw, dtype=torch.bool)))
        size_hw = (
            round(RECONSTRUCTION_WIDTH_PX * view.size_hw[0] / view.size_hw[1]),
            RECONSTRUCTION_WIDTH_PX,
        )
        pictures += [
            picture(resize(to_image(real), size_hw), f"Recorded at {view.t_s:.1f} s, held out"),
            picture(resize(to_image(rgb), size_hw), f"Rendered, {quality:.1f} dB"),
        ]
    return pictures


def _film_path(driven: Driven) -> Path:
    return driven.folder / VIDEOS / f"{driven.name}.webp"


def _stored(path: Path, caption: str) -> Picture:
    """Return a picture from a file as JPEG."""
    return picture(np.asarray(Image.open(path).convert("RGB")), caption)


def _middle_frame(film: Path) -> UInt8[np.ndarray, "H W 3"]:
    with Image.open(film) as frames:
        frames.seek(getattr(frames, "n_frames", 1) // 2)
        return np.asarray(frames.convert("RGB"))


def _cover(image: UInt8[np.ndarray, "H W 3"]) -> Picture:
    """Cut the middle of an image to the size of a cover."""
    cut = ImageOps.fit(Image.fromarray(image), COVER_HW[::-1])
    return picture(np.asarray(cut), "")
