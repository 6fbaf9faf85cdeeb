"""Rounds of the loop for a detector: judged on annotated logs, it learns what resembles its misses."""

import dataclasses
from pathlib import Path

import pytest
from joint_heads import with_small_heads
from miniature import write_log

from foredrive.cli.main import main
from foredrive.data import LogPath
from foredrive.data.clip_list import read_clip_list
from foredrive.engine.folder import DRIVES, SUMMARY
from foredrive.engine.summary import read_summary
from foredrive.errors import InputError
from foredrive.runs import Run, open_run, train_run
from foredrive.runs.improve.detectors import MISSED_NATS, DetectorPupil
from foredrive.runs.improve.loop import MOMENTS, RUN, Loop
from foredrive.runs.improve.pupil import Means
from foredrive.runs.improve.records import Improvement, JudgedLogs, ScoredMoment
from foredrive.runs.train.run import STAGES
from foredrive.view.improve_report import difference, rounds_table, write_improve_report


def part(log: LogPath, start_s: float, end_s: float) -> LogPath:
    return LogPath(log.folder, log.maps_dir, ((start_s, end_s),))


@pytest.fixture(scope="module")
def road(tmp_path_factory: pytest.TempPathFactory) -> LogPath:
    """12 s."""
    return write_log(tmp_path_factory.mktemp("long"), "road", frames=121)


@pytest.fixture(scope="module")
def asked(trained: Run, road: LogPath, tmp_path_factory: pytest.TempPathFactory) -> Improvement:
    """A detector that has learned nothing; parts of one log to train on, to choose from and to judge."""
    folder = tmp_path_factory.mktemp("detector") / "run"
    recipe = with_small_heads(trained.recipe, ("detection",))
    run = train_run(recipe, [part(road, 0.0, 4.0)], folder, trained.cache_dir, trained.folder)
    own, pool, judged = part(road, 0.0, 4.0), part(road, 4.0, 8.0), part(road, 8.0, 99.0)
    settings = ("finetune.schedule.steps=1",)
    return Improvement(run.folder, (pool,), (own,), JudgedLogs((judged,)), budget=2, settings=settings)


def test_a_detector_learns_moments_like_those_where_it_misses(asked: Improvement, tmp_path: Path) -> None:
    out = tmp_path / "out"
    result = Loop(asked, out).run(1, lambda result, state: write_improve_report(out, result, state))
    begin, first = result.rounds
    # All judged moments are of the judged part, and failures are the worst of them, 3 s apart
    moments = [item for item in begin.judged.values() if isinstance(item, ScoredMoment)]
    assert len(moments) == len(begin.judged) > 1
    assert min(moment.t_s for moment in moments) >= 8.0
    worst = max(moments, key=lambda moment: moment.missed)
    assert first.failures[0].t_s == worst.t_s
    assert all(failure.kind == "missed" for failure in first.failures)
    assert worst.missed > MISSED_NATS
    chosen = read_clip_list(first.folder / MOMENTS)
    assert len(chosen) == 2
    assert all(4.0 <= 0.5 * (clip.start_s + clip.end_s) < 8.0 for clip in chosen)
    learned = open_run(first.folder / RUN)
    assert learned.start == asked.start.absolute()
    assert (learned.folder / STAGES[1] / "model.safetensors").is_file()
    # The score is the log-likelihood, so that more is better
    assert begin.score == pytest.approx(-sum(moment.nll for moment in moments) / len(moments))
    assert difference(begin, first).mean == pytest.approx(first.score - begin.score)
    assert rounds_table(result).columns[2].title == "log-likelihood, nats"
    assert read_summary(out / SUMMARY)["round_0.missed"] == pytest.approx(
        sum(moment.missed for moment in moments) / len(moments)
    )
    # What was scored stays
    scored = out / "round_0" / DRIVES / "scored" / "frames.jsonl"
    before = scored.stat().st_mtime_ns
    again = Loop(asked, out).run(1)
    assert scored.stat().st_mtime_ns == before
    assert again.rounds[1].score == pytest.approx(first.score)


def test_failures_are_the_worst_moments_that_are_apart(
    asked: Improvement, road: LogPath, tmp_path: Path
) -> None:
    def moment(t_s: float, missed: float) -> ScoredMoment:
        return ScoredMoment(road.name, t_s, 20.0, missed, 0.0, 0.0)

    judged = {
        str(t_s): moment(t_s, missed) for t_s, missed in ((1.0, 9.0), (2.0, 12.0), (5.0, 4.0), (9.0, 2.9))
    }
    failures = DetectorPupil(asked, Means(tmp_path)).failures(tmp_path, judged)
    # 1 s is too near to 2 s, and at 9 s little is missed
    assert [(failure.t_s, failure.log.parts_s) for failure in failures] == [
        (2.0, ((1.99, 2.01),)),
        (5.0, ((4.99, 5.01),)),
    ]


def test_what_does_not_fit_a_detector_is_refused(
    asked: Improvement, road: LogPath, trained: Run, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    def refused(message: str, **changes: object) -> None:
        with pytest.raises(InputError, match=message):
            Loop(dataclasses.replace(asked, **changes), tmp_path / "out").run(1)  # type: ignore[arg-type]
        assert not (tmp_path / "out").exists()

    refused("judges the rounds: leave it out of the pool", pool=(part(road, 7.0, 8.5),))
    refused("the pool has 1 logs that the run was trained on", pool=(part(road, 3.9, 6.0),))
    refused("no strategy 'anew' for what is judged by moments; there are random", strategy="anew")
    twice = part(dataclasses.replace(road, folder=Path("elsewhere") / road.name), 0.0, 1.0)
    refused("two of the logs that judge have one name", held_out=JudgedLogs((road, twice)))
    refused("has no head for detection", start=trained.folder)
    command = ["improve", str(asked.start), "--pool", str(road.folder), "--out", str(tmp_path / "out")]
    assert main(command) == 2
    assert "not the run of a driver" in capsys.readouterr().err
    assert main([*command, "--on", str(road.folder), "--strategy", "random"]) == 2
    assert "the pool has 1 logs that the run was trained on" in capsys.readouterr().err
