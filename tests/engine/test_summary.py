"""Figures on disk and on the screen, and where they come from."""

import json
import math
import os
import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from foredrive.engine.provenance import collect_provenance, command_line, git_commit, peak_rss_gib
from foredrive.engine.summary import numbers, read_summary, write_summary
from foredrive.errors import InputError


def test_numbers_that_json_lacks_become_null(tmp_path: Path) -> None:
    path = tmp_path / "run" / "summary.json"
    write_summary(path, {"b.x": math.nan, "a": math.inf, "n": 3, "s": "text", "f": 0.5, "none": None})
    assert json.loads(path.read_text()) == {
        "b.x": None,
        "a": None,
        "n": 3,
        "s": "text",
        "f": 0.5,
        "none": None,
    }
    assert list(read_summary(path)) == ["b.x", "a", "n", "s", "f", "none"]
    assert list(path.parent.iterdir()) == [path]


def test_words_and_what_could_not_be_counted_are_no_numbers() -> None:
    summary = {"a": 0.5, "n": 3, "zero": 0, "nan": math.nan, "inf": math.inf, "word": "1.0", "none": None}
    assert numbers(summary) == {"a": 0.5, "n": 3.0, "zero": 0.0}


def test_what_is_not_a_summary_is_named(tmp_path: Path) -> None:
    (tmp_path / "half.json").write_text('{"a": 1')
    (tmp_path / "list.json").write_text("[1]")
    for name in ("half.json", "list.json", "missing.json"):
        with pytest.raises(InputError, match=name):
            read_summary(tmp_path / name)


def test_provenance_is_complete_and_flat() -> None:
    origin = collect_provenance()
    assert all(isinstance(value, (str, int, float, type(None))) for value in origin.values())
    assert origin["machine.cores"] >= 1
    assert origin["machine.ram_gib"] > 0.5
    assert origin["version.torch"]
    assert origin["commit"] is None or re.fullmatch(r"[0-9a-f]{12}(\+[0-9a-f]{8})?", origin["commit"])


def test_the_command_without_folders(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys, "argv", ["/somewhere/bin/foredrive", "evaluate", "runs/a b"])
    assert command_line() == "foredrive evaluate 'runs/a b'"
    monkeypatch.setattr(sys, "argv", ["/somewhere/foredrive/__main__.py", "demo"])
    assert command_line() == "python -m foredrive demo"


def test_a_commit_with_changes_says_so(tmp_path: Path) -> None:
    package = tmp_path / "src" / "foredrive"
    package.mkdir(parents=True)
    (package / "__init__.py").write_text("")

    def git(*arguments: str) -> None:
        identity = ["-c", "user.name=t", "-c", "user.email=t@example.org"]
        subprocess.run(["git", "-C", str(tmp_path), *identity, *arguments], check=True, capture_output=True)

    assert git_commit(tmp_path) is None
    git("init")
    git("add", ".")
    git("commit", "-m", "first")
    clean = git_commit(tmp_path)
    assert clean is not None
    assert len(clean) == 12
    (tmp_path / "notes.txt").write_text("not code")
    assert git_commit(tmp_path) == clean
    (package / "new.py").write_text("a = 1")
    one = git_commit(tmp_path)
    assert one is not None
    assert one.startswith(f"{clean}+")
    (package / "new.py").write_text("a = 2")
    two = git_commit(tmp_path)
    assert two != one
    (package / "__init__.py").write_text("# changed")
    assert git_commit(tmp_path) not in (one, two)


def test_peak_memory_is_at_least_what_is_held_now() -> None:
    block = np.ones(2**23)  # 64 MiB, touched
    held_gib = int(Path("/proc/self/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE") / 2**30
    assert held_gib - 1e-3 <= peak_rss_gib() <= collect_provenance()["machine.ram_gib"]
    assert block[-1] == 1
