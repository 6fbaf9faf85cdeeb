"""What long verbs say where there is no terminal."""

import threading

import pytest

from foredrive.cli.progress import counted, duration, job_text, progress_lines


@pytest.mark.parametrize(
    ("seconds", "words"),
    [(0.4, "0 s"), (59.4, "59 s"), (59.6, "1 min 0 s"), (200.0, "3 min 20 s"), (7500.0, "2 h 5 min")],
)
def test_durations(seconds: float, words: str) -> None:
    assert duration(seconds) == words


def test_the_time_left_is_at_the_rate_so_far() -> None:
    assert job_text("recording drives", 0, 4, 60.0) == "recording drives: 0 of 4"
    assert job_text("recording drives", 1, 4, 60.0) == "recording drives: 1 of 4, 3 min 0 s left"
    assert job_text("recording drives", 4, 4, 60.0) == "recording drives: 4 of 4"


def test_lines_are_written_while_one_job_lasts_and_not_after() -> None:
    lines: list[str] = []
    threads = threading.active_count()
    second = threading.Event()

    def write(line: str) -> None:
        lines.append(line)
        if len(lines) == 2:
            second.set()

    with progress_lines(lambda: "checking logs: 0 of 1", every_s=0.001, write=write):
        assert second.wait(60), "no line while the job lasted"
    assert lines[0].startswith("checking logs: 0 of 1, ")
    assert threading.active_count() == threads, "a thread goes on writing"


def test_an_item_counts_when_it_has_been_worked_on() -> None:
    ticks: list[int] = []
    items = counted("ab", lambda: ticks.append(1))
    assert (next(items), len(ticks)) == ("a", 0)
    assert (next(items), len(ticks)) == ("b", 1)
    assert list(items) == []
    assert len(ticks) == 2
