"""The sections of the demo's report. Each function does a step of `runs.demo` and links its report."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from jaxtyping import UInt8
from PIL import Image, ImageOps

from foredrive.data.batches import stack_records
from foredrive.engine.metrics_log import read_metrics
from foredrive.runs.demo import (
    DRIVER,
    TEXTS,
    Demo,
    Driven,
    Judged,
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
from foredrive.view.contact_sheet import write_contact_sheet
from foredrive.view.demo_report import Section
from foredrive.view.drive_report import REPORT, VIDEOS, threat_text, write_drive_report
from foredrive.view.example_panel import labelled_voxels, predicted_voxels
from foredrive.view.html import Picture, picture, stored_film
from foredrive.view.improve_report import film_of, write_improve_report
from foredrive.view.log_frames import CAMERA_WIDTH_PX, LogFrames
from foredrive.view.log_sheet import write_log_sheet
from foredrive.view.overview import Overview, write_overview
from foredrive.view.reconstruction_sheet import write_reconstruction_sheet
from foredrive.view.run_report import report_on_run, write_run_report
from foredrive.view.search_sheet import query_line, write_search_sheet
from foredrive.view.summary_tables import PRIOR
from foredrive.view.table import number

COVER_HW = (225, 400)
IOU = "occupancy.above_ground.iou_now"
L2 = "uniad.l2_avg_m"
FILM = (
    "The drive at twice real time: what it plans (red), and what it sees: lights as rings where it would "
    "stop, road users on its route in orange. True lights are lines"
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
        [_stored(moment, "A moment in Town05: lidar and boxes in the images and from above")],
        {"all drives, with their paths": sheet},
    )


def show_shipped(demo: Demo) -> Section:
    """Show the predictions of the shipped model in the held-out town."""
    judged = judge_shipped(demo)
    best = _fullest(judged.examples)
    write_overview(demo.out / "hero.png", Overview.of(best))
    return Section(
        _figures(judged),
        _cover(predicted_voxels(best, 0)),
        [_stored(demo.out / "hero.png", "Six cameras go in; occupancy and a plan come out")],
        {"its report": _run_report(judged, demo.out / "seen")},
    )


def show_training(demo: Demo) -> Section:
    """Train a model from scratch; show what it predicts."""
    judged = train_tiny(demo)
    steps = [step for stage in STAGES for step in read_metrics(judged.run.folder / stage / "metrics.jsonl")]
    minutes = sum(float(step["step_s"]) for step in steps) / 60
    best = _fullest(judged.examples)
    return Section(
        f"{len(steps)} steps in {minutes:.1f} min: {_figures(judged)}",
        _cover(predicted_voxels(best, 0)),
        [
            picture(predicted_voxels(best, 0), "Predicted occupancy, coloured by height"),
            picture(labelled_voxels(best, 0), "Labels: what the lidar's beams hit"),
        ],
        {"its report, with losses": _run_report(judged, judged.run.folder)},
    )


def show_drive(demo: Demo) -> Section:
    """Drive a route; show the film."""
    driven = drive_route(demo)
    for one in driven.values():
        write_drive_report(one.folder)
    score, experts = (driven[agent].record.driving_score_1_0 for agent in (DRIVER, EXPERT))
    film = _film_path(driven[DRIVER])
    return Section(
        f"driving score {score:.0f}; the expert, which knows the state of the town, {experts:.0f}",
        _cover(_middle_frame(film)),
        [stored_film(film, FILM)],
        {"its report": driven[DRIVER].folder / REPORT, "the expert's": driven[EXPERT].folder / REPORT},
    )


def show_reconstruction(demo: Demo) -> Section:
    """Reconstruct a drive; show the films of the car in the way, and held-out images."""
    reconstructed = reconstruct_drive(demo)
    scene, reports = reconstructed.scene, dict[str, Path]()
    if scene.held_out.cameras:
        sheet = scene.folder / "held_out.png"
        write_reconstruction_sheet(sheet, scene.scene, scene.held_out.cameras, "held-out images")
        reports["held-out images, recorded and rendered"] = sheet
    films = []
    for agent, one in reconstructed.met.items():
        write_drive_report(one.folder)
        reports[f"the drive of {agent}"] = one.folder / REPORT
        assert one.record.threat is not None
        films.append(
            stored_film(_film_path(one), f"{agent} {MET_BY[agent]}: {threat_text(one.record.threat)}")
        )
    psnr, nearest = (number(scene.summary.get(key), 1) for key in ("psnr_db", "nearest.psnr_db"))
    return Section(
        f"{psnr} dB on held-out images (the nearest recorded image: {nearest} dB), and a car that was "
        "never there",
        _cover(_middle_frame(_film_path(reconstructed.met[CORRIDOR]))),
        films,
        reports,
    )


def show_search(demo: Demo) -> Section:
    """Search the recorded drives; show the hits of the first text."""
    results = search_logs(demo)
    sheets = {}
    for place, result in enumerate(results, 1):
        sheets[query_line(result.query)] = demo.out / f"hits_{place}.png"
        write_search_sheet(demo.out / f"hits_{place}.png", result.query, result.hits)
    hits, (text, first) = len(results[0].hits), next(iter(sheets.items()))
    shown = _stored(first, text)
    return Section(
        f"{hits} hits for “{next(iter(TEXTS))}” and {len(results) - 1} other queries",
        _cover(_stored_image(first)) if hits else None,
        [shown] if hits else [],
        sheets,
    )


def show_improvement(demo: Demo) -> Section:
    """Do one round of the loop; show the drives before and after."""
    result = improve_driver(demo)
    out = demo.out / "improved"
    write_improve_report(out, result)
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
        films,
        {"the failures, and what was chosen for them": out / REPORT},
    )


def _figures(judged: Judged) -> str:
    """Return the main figures of a model, each beside that of a baseline which sees nothing."""
    keys = (IOU, f"{IOU}.{PRIOR}", f"planning.{L2}", f"planning.ego_mlp.{L2}")
    iou, prior, plan, blind = (number(judged.summary.get(key), 2) for key in keys)
    plans = f"plan {plan} m from the expert's (without sight {blind} m)"
    return f"occupancy IoU {iou} (without sight {prior}), {plans}"


def _run_report(judged: Judged, folder: Path) -> Path:
    report = report_on_run(judged.run, judged.logs, judged.summary, judged.examples)
    write_run_report(folder / REPORT, report)
    return folder / REPORT


def _fullest(examples: Sequence[ExamplePrediction]) -> ExamplePrediction:
    """Return the example with the most labelled columns of cars."""

    def cars(shown: ExamplePrediction) -> int:
        clip = shown.example.clip
        boxes, labels = clip.boxes[clip.now], shown.example.occupancy[clip.now]
        return int(car_columns(stack_records([boxes]), stack_records([labels]), RANGES_M[-1]).sum())

    return max(examples, key=cars)


def _film_path(driven: Driven) -> Path:
    return driven.folder / VIDEOS / f"{driven.name}.webp"


def _stored(path: Path, caption: str) -> Picture:
    """Return a picture from a file as JPEG."""
    return picture(_stored_image(path), caption)


def _stored_image(path: Path) -> UInt8[np.ndarray, "H W 3"]:
    return np.asarray(Image.open(path).convert("RGB"))


def _middle_frame(film: Path) -> UInt8[np.ndarray, "H W 3"]:
    with Image.open(film) as frames:
        frames.seek(getattr(frames, "n_frames", 1) // 2)
        return np.asarray(frames.convert("RGB"))


def _cover(image: UInt8[np.ndarray, "H W 3"]) -> Picture:
    """Cut the middle of an image to the size of a cover."""
    cut = ImageOps.fit(Image.fromarray(image), COVER_HW[::-1])
    return picture(np.asarray(cut), "")
