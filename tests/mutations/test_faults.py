"""Each fault of `faults.toml` is noticed by a test that it names."""

from pathlib import Path

import pytest
from mutations.mutant import REPOSITORY, Fault, faults, occurrences, run_tests_with

FAULTS = faults()


def test_the_list_is_true() -> None:
    stale = {fault.what: occurrences(fault) for fault in FAULTS if occurrences(fault) != 1}
    assert not stale, f"the original text of a fault must stand in its file exactly once: {stale}"
    named = {test.partition("::") for fault in FAULTS for test in fault.tests}
    missing = [
        file + mark + name
        for file, mark, name in named
        if f"def {name.partition('[')[0]}" not in (REPOSITORY / "tests" / file).read_text()
    ]
    assert not missing, f"tests that are named and do not exist: {missing}"
    assert len({fault.what for fault in FAULTS}) == len(FAULTS)


@pytest.mark.slow
@pytest.mark.parametrize("fault", FAULTS, ids=[fault.what for fault in FAULTS])
def test_a_fault_is_noticed(fault: Fault, tmp_path: Path) -> None:
    assert occurrences(fault) == 1, f"{fault.file} no longer holds the text once: {fault.original!r}"
    run = run_tests_with(fault, tmp_path)
    # 1: tests failed. Anything else is a fault that passes, or tests that did not run.
    assert run.returncode == 1, f"not noticed by {', '.join(fault.tests)}\n{run.stdout[-3000:]}"
