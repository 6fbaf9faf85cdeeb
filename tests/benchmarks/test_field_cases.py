"""The list of cases from the field names tests that exist."""

import tomllib
from pathlib import Path

TESTS = Path(__file__).parents[1]


def test_each_case_names_a_test() -> None:
    cases = tomllib.loads((TESTS / "field_cases.toml").read_text())
    assert len(cases) > 40
    for case, test in cases.items():
        file, _, name = test.partition("::")
        assert f"def {name}(" in (TESTS / file).read_text(), case
