"""Rounds of the loop: failures of drives, the choice of moments, and a whole round that goes on."""

import dataclasses
import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from builders import routes_along
from jaxtyping import Float
from numpy import ndarray

from foredrive.cli.main import main
from foredrive.data.clip_list import read_clip_list
from foredrive.data.log_paths import LogPath
from foredrive.driver.recipes import DriverRecipe, driver_small
from foredrive.driving.drive_record import DrivenTrack, DriveRecord
from foredrive.driving.ncap.outcome import Outcome, SafetyResult
from foredrive.driving.replay.threats import Threat
from foredrive.driving.scores import Ending, Infraction, InfractionKind, RouteScore
from foredrive.engine.folder import DRIVES, SUMMARY
from foredrive.engine.summary import read_summary
from foredrive.errors import InputError
from foredrive.runs.drive.in_reconstruction import ReconstructedRoutes
from foredrive.runs.drive.in_towns import TownRoutes
from foredrive.runs.drive.records import read_drive, write_drive
from foredrive.runs.improve.choosing import STRATEGIES, Moments, Request, choose
from foredrive.runs.improve.failures import Failure, counted, failures_of, logs_before
from foredrive.runs.improve.loop import MOMENTS, RUN, Loop, folder_of
from foredrive.runs.improve.records import Improvement, JudgedLogs, LoopResult, Round, score_of
from foredrive.runs.reconstruction.reconstruction_run import open_run_log
from foredrive.runs.train.driver import open_driver, train_driver
from foredrive.search.rows import IndexRow
from foredrive.sensors.rigs import FRONT_TELE, camera_rig
from foredrive.towns import virtual_egos
from foredrive.towns.sensing.capture import SensorSuite
from foredrive.towns.world import World
from foredrive.view.improve_report import difference, rounds_table, write_improve_report


def drive_of(
    ending: Ending = Ending.COMPLETED, *infractions: Infraction, route: str = "1", error: str = ""
) -> DriveRecord:
    """Return a drive of 20 s that moves at 5 m/s for the first 10 s, then stands."""
    t_s = tuple(0.25 * k for k in range(81))
    score = RouteScore(route, 0, 1.0, 0.0, ending, infractions, 50.0, 20.0)
    return DriveRecord(
        town="Town02",
        length_m=50.0,
        score=score,
        driving_score_1_0=score.driving_score_1_0,
        driving_score_2_1=score.driving_score_2_1,
        error=error,
        events=(),
        comfort=None,
        nearest_s=(),
        act_s=(),
        route_xy=((0.0, 0.0), (50.0, 0.0)),
        track=DrivenTrack(
            t_s,
            tuple((min(5.0 * t, 50.0), 0.0) for t in t_s),
            tuple(0.0 for _ in t_s),
            tuple(5.0 if t < 10 else 0.0 for t in t_s),
        ),
        wall_s=1.0,
        log=f"logs/town_train/route{route}_rep0",
    )


def hit(t_s: float, kind: InfractionKind = InfractionKind.RED_LIGHT) -> Infraction:
    return Infraction(kind, t_s, (5.0 * t_s, 0.0))


def test_failures_are_events_and_stops_with_the_seconds_before_them(tmp_path: Path) -> None:
    drives = {
        "a": drive_of(Ending.COMPLETED, hit(12.0), hit(2.0), hit(3.5, InfractionKind.COLLISION_VEHICLE)),
        "b": drive_of(Ending.BLOCKED, route="2"),
        "c": drive_of(route="3"),
        "d": drive_of(Ending.CRASHED, hit(4.0), route="4", error="no plan"),
    }
    for name, drive in drives.items():
        write_drive(tmp_path / DRIVES / f"{name}.json", drive)
    failures = failures_of(tmp_path)
    # What follows within 3 s belongs to a failure; a drive that stood failed where it stopped
    assert [(f.drive, f.kind, f.t_s) for f in failures] == [
        ("a", "red_light", 2.0),
        ("a", "red_light", 12.0),
        ("b", "blocked", 9.75),
    ]
    assert [f.log.parts_s for f in failures] == [((0.0, 2.0),), ((9.0, 12.0),), ((6.75, 9.75),)]
    assert counted(failures) == "3 failures (2 red light, 1 blocked)"
    first, second = logs_before(failures)
    assert first.folder == tmp_path / "logs/town_train/route1_rep0"
    assert first.parts_s == ((0.0, 2.0), (9.0, 12.0))
    assert second.parts_s == ((6.75, 9.75),)


def test_only_who_is_hit_or_leaves_the_way_fails_a_safety_test(tmp_path: Path) -> None:
    collided = drive_of(Ending.COLLISION, hit(4.0, InfractionKind.COLLISION_VEHICLE), route="1")
    drives = {
        "hit": (collided, Outcome.COLLIDED, 1.5),
        "left": (drive_of(Ending.DEVIATION, route="2"), Outcome.LEFT_WAY, 0.0),
        "stood": (drive_of(Ending.TIMEOUT, route="3"), Outcome.STOPPED_SHORT, 5.0),
        "untrusted": (drive_of(Ending.UNTRUSTED, route="4"), Outcome.UNTRUSTED, None),
    }
    for name, (drive, outcome, score) in drives.items():
        threat = SafetyResult(Threat.SIDE, outcome, None, None, 9.0, score, 0.5)
        write_drive(tmp_path / DRIVES / f"{name}.json", dataclasses.replace(drive, threat=threat))
    failures = [(f.drive, f.kind, f.t_s) for f in failures_of(tmp_path)]
    assert failures == [("hit", "collision_vehicle", 4.0), ("left", "deviation", 9.75)]
    scores = {path.stem: score_of(read_drive(path)) for path in (tmp_path / DRIVES).glob("*.json")}
    # Each went half of the way; who left the trusted region has no score
    assert scores == {"hit": 15.0, "left": 0.0, "stood": 50.0, "untrusted": None}


def test_drives_without_a_score_count_in_neither_round() -> None:
    def against_threats(number: int, **scores: float | None) -> Round:
        judged = {}
        for name, score in scores.items():
            outcome = Outcome.UNTRUSTED if score is None else Outcome.STOPPED_SHORT
            threat = SafetyResult(Threat.SIDE, outcome, None, None, 9.0, score, 0.5)
            judged[name] = dataclasses.replace(drive_of(route=name), threat=threat)
        return Round(number, Path(), Path(), judged=judged, suite=Path("suite"))

    begin, later = against_threats(0, a=5.0, b=1.0, c=None), against_threats(1, a=4.0, b=None, c=5.0)
    assert (begin.score, later.score) == (30.0, 45.0)
    assert difference(begin, later).mean == -10.0  # of a alone
    table = rounds_table(LoopResult([begin, later]))
    assert "2 drives of all rounds have no score and are left out" in table.notes[0]
    with pytest.raises(InputError, match="suite: no drive has a score"):
        against_threats(1, a=None).score  # noqa: B018 - raises


def row(log: str, t_s: float) -> IndexRow:
    blank = dict.fromkeys(("azimuth_deg", "place", "ego_speed_mps", "time_of_day", "weather", "caption"))
    return IndexRow(
        key=f"{log}@{round(1e6 * t_s)}",
        log=log,
        folder=Path("logs") / log,
        maps_dir=Path("maps"),
        frame=round(2 * t_s),
        t_us=round(1e6 * t_s),
        t_s=t_s,
        view="all",
        counts={},
        **blank,  # type: ignore[arg-type]
    )


def unit(*angles_deg: float) -> Float[ndarray, "n 2"]:
    angles = np.deg2rad(angles_deg)
    return np.stack([np.cos(angles), np.sin(angles)], -1)


def request(budget: int, seed: int = 0) -> Request:
    """Return a pool at 0, 10, … 90 degrees; failures at 0 and at 90 degrees."""
    rows = [row(f"s/{k // 2}", 1.0 + 0.5 * (k % 2)) for k in range(10)]
    failures = [
        Failure(
            name,
            name,
            "red_light",
            "",
            3.0,
            (0.0, 0.0),
            None,
            LogPath(Path("f") / name, Path(), ((0.0, 3.0),)),
        )
        for name in ("a", "b")
    ]
    before = Moments([row("f/a", 2.5), row("f/b", 1.0), row("f/b", 3.5)], unit(0.0, 90.0, 45.0))
    unsure = {of.key: float(k % 3) for k, of in enumerate(rows)}
    return Request(
        Moments(rows, unit(*range(0, 100, 10))), failures, before, lambda: unsure, budget,
        np.random.default_rng(seed),
    )  # fmt: skip


def angles(strategy: str, budget: int, seed: int = 0) -> list[int]:
    """Return the angles of the chosen moments, degrees."""
    asked = request(budget, seed)
    place = {of.key: 10 * k for k, of in enumerate(asked.pool.rows)}
    return [place[chosen.row.key] for chosen in choose(strategy, asked)]


def test_failures_take_turns_and_neighbours_in_time_count_once() -> None:
    # Without 10 and 80: each is half a second from a better one. 45 degrees lie after the failure
    assert angles("failures", 4) == [0, 90, 20, 70]
    assert angles("uncertainty", 3) == [20, 50, 80]


def test_diverse_moments_are_far_from_each_other() -> None:
    begin, other = angles("diversity", 2)
    assert other == (90 if begin < 45 else 0)
    assert set(angles("failures-diversity", 2)) == {0, 90}


def test_random_moments_follow_the_seed_and_end_with_the_pool() -> None:
    assert angles("random", 5, seed=1) == angles("random", 5, seed=1)
    assert any(angles("random", 5, seed=seed) != angles("random", 5) for seed in range(1, 4))
    assert len(angles("random", 100)) == 5  # one for each log


def recipe() -> DriverRecipe:
    small = driver_small()
    return dataclasses.replace(
        small,
        clips=dataclasses.replace(small.clips, image_hw=(32, 64)),
        eyes=dataclasses.replace(small.eyes, signs=False),  # these weights do not stand still
        see=dataclasses.replace(small.see, batch_size=4, epochs=None, steps=2),
        plan=dataclasses.replace(small.plan, steps=5, clips=5, speeds=2),
    )


@pytest.fixture(scope="module")
def egos(world02: World, tmp_path_factory: pytest.TempPathFactory) -> dict[int, list[LogPath]]:
    """Virtual egos of three seeds."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(virtual_egos, "World", lambda town, seed, conditions: world02)
        sensors = SensorSuite(camera_rig(plan=FRONT_TELE.of_size((32, 64))), None)
        out = tmp_path_factory.mktemp("egos")
        return {
            seed: virtual_egos.record_virtual_egos("Town02", seed, 3, out / str(seed), sensors)
            for seed in (3, 4)
        }


@pytest.fixture(scope="module")
def asked(
    egos: dict[int, list[LogPath]], routes: Path, tmp_path_factory: pytest.TempPathFactory
) -> Improvement:
    """A driver that has learned nothing, in two routes of 14 m."""
    start = train_driver(recipe(), egos[3], tmp_path_factory.mktemp("start") / "driver")
    source = TownRoutes(str(routes), rig=FRONT_TELE.of_size((32, 64)), vehicles=2, people=0, scenarios=False)
    return Improvement(
        start.folder, tuple(egos[4]), tuple(egos[3]), source, budget=4, settings=("see.steps=1",)
    )


@pytest.fixture(scope="module")
def once(asked: Improvement, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, LoopResult]:
    """The folder and the result of one round."""
    out = tmp_path_factory.mktemp("loop") / "out"
    return out, Loop(asked, out).run(1, lambda result, state: write_improve_report(out, result, state))


def test_a_round_learns_moments_of_the_pool_and_is_judged(
    asked: Improvement, once: tuple[Path, LoopResult]
) -> None:
    out, result = once
    begin, first = result.rounds
    chosen = read_clip_list(first.folder / MOMENTS)
    assert len(chosen) == len(first.hits) == 4
    assert {clip.folder for clip in chosen} <= {log.folder for log in asked.pool}
    learned = open_driver(first.folder / RUN)
    assert learned.start == asked.start
    assert learned.logs[: len(asked.logs)] == asked.logs
    # Each chosen moment is a part of its own, which holds this one key frame
    parts = [part for log in learned.logs[len(asked.logs) :] for part in log.parts_s]
    assert sorted(0.5 * (start + end) for start, end in parts) == pytest.approx(
        sorted(hit.row.t_s for hit in first.hits)
    )
    assert max(end - start for start, end in parts) < 0.1
    assert set(first.judged) == set(begin.judged) == {"routea_rep0", "routeb_rep0"}
    gain = first.score - begin.score
    assert difference(begin, first).mean == pytest.approx(gain)
    summary = read_summary(out / SUMMARY)
    assert summary["round_1.driving_score_1_0"] == pytest.approx(first.score)
    assert summary["round_1.moments"] == 4
    page = (out / "report.html").read_text()
    assert f"{len(first.failures)} failures" in page
    table = rounds_table(result)
    assert len(table.sections[0].rows) == 2
    assert table.sections[0].rows[1].cells[3] == f"{gain:+.1f}"  # two routes have no interval
    assert "fewer than 10 routes" in table.notes[0]


def test_a_loop_goes_on_and_has_other_moments_in_the_next_round(
    asked: Improvement, once: tuple[Path, LoopResult]
) -> None:
    out, result = once
    files = [path for path in out.rglob("*") if path.suffix in (".safetensors", ".json")]
    made = {path: path.stat().st_mtime_ns for path in files}
    longer = Loop(asked, out).run(2)
    kept = [
        path for path in files if path.match("run/*/model.safetensors") or path.match("drives/drives/*.json")
    ]
    assert len(kept) == 6  # eyes and driver of the round, two drives of it, and two of the beginning
    assert [path.stat().st_mtime_ns for path in kept] == [made[path] for path in kept]
    assert [hit.row.key for hit in longer.rounds[1].hits] == [hit.row.key for hit in result.rounds[1].hits]
    keys = [{hit.row.key for hit in of_number.hits} for of_number in longer.rounds]
    assert keys[1].isdisjoint(keys[2])
    second = open_driver(longer.rounds[2].run)
    assert sum(len(log.parts_s) for log in second.logs) == len(keys[1]) + len(keys[2])
    with pytest.raises(InputError, match="another loop"):
        Loop(dataclasses.replace(asked, budget=5), out).run(1)
    # The pool has fewer moments than two more rounds would need
    ended = Loop(asked, out).run(9)
    assert ended.ended == "the pool is used up"


def write_log(folder: Path, boxes: str) -> LogPath:
    folder.mkdir(exist_ok=True)
    for name, text in (("sync", "times"), ("box_detections_se3", boxes)):
        (folder / f"{name}.arrow").write_text(text)
    return LogPath(folder, folder)


@pytest.mark.parametrize("changed", ["weights", "routes", "held_out", "boxes", "nothing"])
def test_a_loop_is_of_its_run_and_routes_by_their_contents(
    changed: str, routes: Path, tmp_path: Path
) -> None:
    """A folder of another version is refused, and a folder of the same one goes on."""
    start, files = tmp_path / "start", [tmp_path / "searched.xml", tmp_path / "held_out.xml"]
    start.mkdir()
    (start / "config.yaml").write_text("recipe")
    weights = start / "model.safetensors"
    weights.write_bytes(b"1")
    for file in files:
        file.write_text(routes.read_text())
    log = write_log(tmp_path / "log", "one")
    searched = JudgedLogs((log,)) if changed == "boxes" else TownRoutes(str(files[0]))
    asked = Improvement(start, (), (), searched, TownRoutes(str(files[1])))
    assert not folder_of(asked, tmp_path / "out").check()
    with folder_of(asked, tmp_path / "out").claimed():
        pass
    longer = routes.read_text() + "<!-- changed -->"
    changes: dict[str, tuple[str, Callable[[], object]]] = {
        "weights": (f"the rounds of another version of {start}", lambda: weights.write_bytes(b"2")),
        "routes": (f"the rounds of another version of {files[0]}", lambda: files[0].write_text(longer)),
        "held_out": (f"the rounds of another version of {files[1]}", lambda: files[1].write_text(longer)),
        "boxes": ("the rounds of another version of the judging logs", lambda: write_log(log.folder, "two")),
    }
    if changed == "nothing":
        assert folder_of(asked, tmp_path / "out").check()
        return
    message, change = changes[changed]
    change()
    with pytest.raises(InputError, match=f"holds {message}; choose another folder"):
        folder_of(asked, tmp_path / "out").check()


def judged(number: int, *infractions: Infraction) -> Round:
    return Round(number, Path(), Path(str(number)), judged={"a": drive_of(Ending.COMPLETED, *infractions)})


def test_a_worse_round_is_dropped_and_the_next_compared_with_the_best() -> None:
    begin, worse, better = judged(0, hit(2.0)), judged(1, hit(2.0), hit(9.0)), judged(2)
    for keep_best, kept, after_worse in ((True, [True, False, True], "0"), (False, [True] * 3, "1")):
        result = LoopResult([begin]).followed_by(worse, keep_best=keep_best)
        assert result.best.run == Path(after_worse)
        # 49 of two red lights, 70 of one: this round is worse than the beginning, not than the dropped one
        same = result.followed_by(judged(2, hit(2.0), hit(6.0)), keep_best=True)
        assert same.rounds[-1].kept is not keep_best
        result = result.followed_by(better, keep_best=keep_best)
        assert [of_number.kept for of_number in result.rounds] == kept
        assert result.best.run == Path("2")


def test_held_out_routes_judge_a_round(asked: Improvement, tmp_path: Path) -> None:
    held = dataclasses.replace(asked.routes, routes=str(routes_along(tmp_path / "held.xml", "Town01")))
    loop = Loop(dataclasses.replace(asked, held_out=held, budget=2), tmp_path / "out")
    begin, first = loop.run(1).rounds
    assert set(first.judged) == {"routea_rep0", "routeb_rep0"}
    assert {drive.town for drive in (*begin.judged.values(), *first.judged.values())} == {"Town01"}
    # Failures are of the other routes
    assert {failure.town for failure in first.failures} == {"Town02"}
    assert not (first.folder / DRIVES).exists()  # no round follows


@pytest.mark.parametrize("strategy", [name for name in STRATEGIES if name in ("uncertainty", "anew")])
def test_strategies_that_look_with_the_driver(asked: Improvement, strategy: str, tmp_path: Path) -> None:
    result = Loop(dataclasses.replace(asked, strategy=strategy), tmp_path / "out").run(1)
    first = result.rounds[1]
    assert len(first.hits) == 4
    folders = {hit.row.folder for hit in first.hits}
    if strategy == "anew":
        assert [hit.score for hit in first.hits] == sorted((hit.score for hit in first.hits), reverse=True)
        new = first.folder / "anew"
        assert all(folder.is_relative_to(new) for folder in folders)
        assert json.loads((new / "suite.json").read_text())["seed"] != asked.routes.seed
    else:
        scores = [hit.score for hit in first.hits]
        assert scores == sorted(scores, reverse=True)
        assert 0 < scores[-1] <= scores[0] <= 2


def test_failures_in_a_rebuilt_log_are_replayed_in_other_forms(
    asked: Improvement, reconstructed: Path, tmp_path: Path
) -> None:
    source = ReconstructedRoutes(str(reconstructed), threats=tuple(Threat))
    trial = dataclasses.replace(asked, routes=source, strategy="anew", budget=12)
    states: list[str] = []
    out = tmp_path / "out"

    def report(result: LoopResult, state: str) -> None:
        states.append(state)
        write_improve_report(out, result, state)
        assert ("http-equiv" in (out / "report.html").read_text()) == bool(state)
        assert (out / SUMMARY).is_file() == (not state)

    result = Loop(trial, out).run(1, report)
    begin, first = result.rounds
    assert states == [
        "judging for the first time",
        "round 1: choosing moments, and training on them",
        "round 1: judging again",
        "",
    ]
    # A driver that has learned nothing is hit
    failed = {failure.route for failure in first.failures}
    assert failed
    assert failed <= {"from0.5s_stationary", "from0.5s_frontal", "from0.5s_side"}
    new = sorted(path.stem for path in (first.folder / "anew" / DRIVES).glob("*.json"))
    assert {name.rpartition("_")[0] for name in new} == failed
    assert len(new) > len(failed)
    assert 6 < len(first.hits) <= 12
    assert {hit.row.log.rpartition("/")[2] for hit in first.hits} <= set(new)
    assert "NeuroNCAP score" in (out / "report.html").read_text()
    assert 0.0 <= begin.score <= 100.0
    again = source.anew(["from0.5s_side"], 3, 7)
    names = [job.name for job in again.jobs(str(asked.start))]
    assert set(names) <= {f"from0.5s_side_{k}" for k in range(3)}
    assert names
    _, log = open_run_log(reconstructed)
    with pytest.raises(InputError, match="the driver is judged in its reconstruction"):
        Loop(dataclasses.replace(trial, pool=(*asked.pool, log)), tmp_path / "other").run(1)


def test_pools_that_spoil_the_judgement_are_refused(
    asked: Improvement, egos: dict[int, list[LogPath]], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    mixed = dataclasses.replace(asked, pool=(*asked.pool, egos[3][0]))
    with pytest.raises(InputError, match="the pool has 1 logs that the run was trained on, such as"):
        Loop(mixed, tmp_path / "out").run(1)
    judged = dataclasses.replace(asked, held_out=asked.routes)
    with pytest.raises(InputError, match="recorded in Town02, where the routes that judge"):
        Loop(judged, tmp_path / "out").run(1)
    gone = dataclasses.replace(asked, logs=(LogPath(tmp_path / "gone", tmp_path),))
    with pytest.raises(InputError, match="gone: a log that the run was trained on is not here; --logs"):
        Loop(gone, tmp_path / "out").run(1)
    pool = str(egos[4][0].folder)
    arguments = ["improve", str(asked.start), "--pool", pool, "--out", str(tmp_path / "out")]
    assert main([*arguments, "--strategy", "luck"]) == 2
    assert (
        "no strategy 'luck' for what is judged by drives; there are random, uncertainty"
        in capsys.readouterr().err
    )
    assert main([*arguments, "--on", pool, "--only", "Town02-1"]) == 2
    assert "--only: for routes through towns; with --on there are none" in capsys.readouterr().err
    assert main([*arguments, "--routes", "nowhere.xml"]) == 2
    assert "nowhere.xml" in capsys.readouterr().err
