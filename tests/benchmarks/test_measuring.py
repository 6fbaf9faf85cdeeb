"""Time and memory of a piece of code."""

import mmap
import sys
from pathlib import Path

import pytest

from benchmarks.common.measuring import compare, forget_peak, held_mib, in_a_process, measure, peak_mib

FAST = {"forward_ms": 1.0, "backward_ms": 3.0, "forward_cpu_ms": 2.0, "backward_cpu_ms": 2.0, "peak_mib": 5.0}
SLOW = {
    "forward_ms": 6.0,
    "backward_ms": 2.0,
    "forward_cpu_ms": 4.0,
    "backward_cpu_ms": 8.0,
    "peak_mib": 50.0,
}


def test_two_paths_are_compared_by_all_their_time() -> None:
    figures = compare(FAST, SLOW)
    assert (figures["speedup"], figures["speedup_cpu"], figures["memory_ratio"]) == (2.0, 3.0, 0.1)
    assert (figures["fast.backward_ms"], figures["reference.backward_ms"]) == (3.0, 2.0)


def test_sleeping_takes_time_but_not_the_processors(monkeypatch: pytest.MonkeyPatch) -> None:
    clock = iter([0.0, 1.0, 10.0, 13.0, 20.0, 22.0])
    monkeypatch.setattr("time.perf_counter", lambda: next(clock))
    monkeypatch.setattr("time.process_time", lambda: 5.0)
    assert measure(lambda: None, 3, "cpu") == (2.0, 0.0)


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="reads /proc")
def test_what_was_held_for_a_moment_shows_in_the_peak() -> None:
    forget_peak("cpu")
    before = held_mib("cpu")
    with mmap.mmap(-1, 64 * 2**20) as pages:  # never what the heap has kept from before
        for _ in range(64):  # in pieces: the heap keeps what is freed once a test has run the program
            pages.write(b"\1" * 2**20)
    assert peak_mib("cpu") - before > 60
    forget_peak("cpu")
    assert peak_mib("cpu") - before < 30


def test_a_program_hands_its_figures_over(tmp_path: Path) -> None:
    program = tmp_path / "program.py"
    program.write_text(
        "import json, os, sys; print(json.dumps({sys.argv[1]: len(os.environ['NUMBA_CACHE_DIR'])}))"
    )
    assert in_a_process(str(program), "letters")["letters"] > 1
