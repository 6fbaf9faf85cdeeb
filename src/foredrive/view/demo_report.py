"""The report of the demo: a page whose table of contents is the loop, with links to the verbs' reports."""

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

from foredrive.engine.fan_out import reason
from foredrive.runs.demo import Demo
from foredrive.view.html import Picture, Provenance, write_page


@dataclass(frozen=True)
class Section:
    """The results of one step."""

    result: str
    """The outcome in one line, for the loop."""
    cover: Picture | None
    """A small picture, for the loop."""
    figures: Sequence[Picture] = ()
    """Pictures; two stand side by side on a wide screen."""
    reports: Mapping[str, Path] = field(default_factory=dict)
    """Paths of the verbs' own reports by title."""


@dataclass(frozen=True)
class Step:
    """A step of the demo: its texts, and the function that does it and shows its results."""

    title: str
    doing: str
    """What it does, in one line, for the terminal."""
    about: str
    """Explanation for the reader."""
    commands: Sequence[str]
    """Commands that do the same with other data."""
    work: Callable[[Demo], Section]


@dataclass(frozen=True)
class Outcome:
    """A step that is finished or has failed."""

    step: Step
    seconds: float
    section: Section | None
    failure: str = ""
    """Why it failed, in one line."""


def do_steps(steps: Sequence[Step], demo: Demo, say: Callable[[str], None]) -> list[Outcome]:
    """Do all steps; one that fails does not stop the others.

    Raises:
        OSError: the disk is full or cannot be written.
    """
    outcomes = []
    for number, step in enumerate(steps, 1):
        seconds = demo.size.seconds.get(step.title)
        expected = f" (about {seconds} s)" if seconds else ""
        say(f"{number}/{len(steps)} {step.doing}{expected}")
        began, section, failure = time.perf_counter(), None, ""
        try:
            section = step.work(demo)
        except Exception as error:
            failure = reason(step.title, error)
            say(f"{step.title} failed: {failure}")
        outcomes.append(Outcome(step, time.perf_counter() - began, section, failure))
    return outcomes


def write_demo_report(path: Path, outcomes: Sequence[Outcome], provenance: Provenance) -> None:
    """Write the page into the demo's folder."""
    links = {
        outcome.step.title: {
            title: report.relative_to(path.parent).as_posix()
            for title, report in (outcome.section.reports if outcome.section else {}).items()
        }
        for outcome in outcomes
    }
    write_page(
        path,
        "demo_report.html.j2",
        title="Once round the loop",
        provenance=provenance,
        outcomes=outcomes,
        links=links,
        minutes=sum(outcome.seconds for outcome in outcomes) / 60,
    )
