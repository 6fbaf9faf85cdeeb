"""Each fault of `faults.toml` is noticed by a test that it names."""

from pathlib import Path

import pytest
from mutations.mutant import (
    REPOSITORY,
    Fault,
    copy_package,
    copy_with_fault,
    occurrences,
    read_faults,
    run_tests,
)

FAULTS = read_faults()


def test_the_list_is_true() -> None:
    stale = {fault.what: occurrences(fault) for fault in FAULTS if occurrences(fault) != 1}
    assert not stale, f"the original text of a fault must stand in its file exactly once: {stale}"
    named = {test.partition("::") for fault in FAULTS for test in fault.tests}
    missing = [
        file + mark + name
        for file, mark, name in named
        if f"def {name}(" not in (REPOSITORY / "tests" / file).read_text()
    ]
    assert not missing, f"tests that are named and do not exist: {missing}"
    assert len({fault.what for fault in FAULTS}) == len(FAULTS)


@pytest.fixture(scope="module")
def sound(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A copy of the package in which the tests of all selected faults have passed."""
    folder = copy_package(tmp_path_factory.mktemp("sound"))
    parameters = [item.callspec.params for item in request.session.items if hasattr(item, "callspec")]
    selected = [each["fault"] for each in parameters if "fault" in each]
    tests = sorted({test for fault in selected for test in fault.tests})
    run = run_tests(tests, folder)
    assert run.returncode == 0, run.stdout[-3000:] + run.stderr[-3000:]
    return folder


@pytest.mark.slow
@pytest.mark.parametrize("fault", FAULTS, ids=[fault.what for fault in FAULTS])
def test_a_fault_is_noticed(fault: Fault, sound: Path, tmp_path: Path) -> None:
    assert occurrences(fault) == 1, f"{fault.file} no longer holds the text once: {fault.original!r}"
    run = run_tests(fault.tests, copy_with_fault(fault, sound, tmp_path))
    # 1: tests failed. Anything else is a fault that passes, or tests that did not run.
    assert run.returncode == 1, f"not noticed by {', '.join(fault.tests)}\n{run.stdout[-3000:]}"
