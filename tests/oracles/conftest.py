"""Comparison with installed reference code, in `make test-oracles` alone. Nothing is skipped there."""

import os
from collections.abc import Generator

import pytest

ASKED = "FOREDRIVE_ORACLES" in os.environ

collect_ignore = [] if "FOREDRIVE_SCALABEL" in os.environ else ["test_scalabel.py"]


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    if ASKED:
        return
    for item in items:
        if item.get_closest_marker("oracle") is not None:
            item.add_marker(
                pytest.mark.skip(reason="compares with installed reference code: make test-oracles")
            )


@pytest.hookimpl(wrapper=True)
def pytest_runtest_makereport(item: pytest.Item) -> Generator[None, pytest.TestReport, pytest.TestReport]:
    """Turn a skip into a failure: an installation that is not complete must not look like agreement."""
    report = yield
    if ASKED and report.skipped:
        report.outcome, report.longrepr = "failed", f"skipped in `make test-oracles`: {report.longrepr}"
    return report
