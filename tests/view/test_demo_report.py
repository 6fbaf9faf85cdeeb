"""The report of the demo: the loop is its table of contents, and a failed step does not stop the others."""

import dataclasses
import re
from pathlib import Path

import numpy as np
import pytest
from html_pages import EVIL, Page, assert_harmless
from PIL import Image

from foredrive.driving.route_sets import load_route_set
from foredrive.errors import InputError
from foredrive.runs.demo import Demo, full_demo, quick_demo
from foredrive.towns.map.names import TEST_TOWNS
from foredrive.view.demo_report import Outcome, Section, Step, do_steps, write_demo_report
from foredrive.view.demo_steps import STEPS
from foredrive.view.html import Provenance, picture, stored_film

COMMAND = Provenance("foredrive demo", "abc", "2 cores")


def section(demo: Demo) -> Section:
    """Show something of every kind."""
    grey = picture(np.full((9, 16, 3), 90, np.uint8), EVIL)
    return Section(EVIL, grey, [grey, grey], {EVIL: demo.out / "seen" / "report.html"})


def fail(demo: Demo) -> Section:
    """Fail as a step does that finds another run in its folder."""
    raise InputError(f"{demo.out}: holds {EVIL}")


def steps(*work: object) -> list[Step]:
    return [Step(f"Step{k}", "doing", EVIL, (EVIL,), one) for k, one in enumerate(work)]  # type: ignore[arg-type]


def outcomes(tmp_path: Path) -> list[Outcome]:
    return do_steps(steps(section, fail, section), Demo(quick_demo(), tmp_path), lambda line: None)


def test_a_step_that_fails_says_so_and_the_others_go_on(tmp_path: Path) -> None:
    first, failed, last = outcomes(tmp_path)
    assert first.section is not None
    assert last.section is not None
    assert (first.failure, last.failure) == ("", "")
    assert failed.section is None
    assert failed.failure == f"{tmp_path}: holds {EVIL}"


def test_a_long_step_says_how_long_it_takes(tmp_path: Path) -> None:
    size, lines = dataclasses.replace(quick_demo(), seconds={"Step1": 30}), list[str]()
    do_steps(steps(section, section), Demo(size, tmp_path), lines.append)
    assert lines == ["1/2 doing", "2/2 doing (about 30 s)"]
    assert set(full_demo().seconds) == {step.title for step in STEPS}


def test_an_error_of_the_program_is_told_in_one_line(tmp_path: Path) -> None:
    def crash(demo: Demo) -> Section:
        raise ValueError("one\ntwo")

    (outcome,) = do_steps(steps(crash), Demo(quick_demo(), tmp_path), lambda line: None)
    assert outcome.failure == "ValueError: two"


def test_a_full_disk_stops_the_demo(tmp_path: Path) -> None:
    def write(demo: Demo) -> Section:
        raise OSError(28, "No space left on device")

    with pytest.raises(OSError, match="No space"):
        do_steps(steps(write, section), Demo(quick_demo(), tmp_path), lambda line: None)


def test_the_page_is_one_harmless_file_whose_loop_leads_to_its_sections(tmp_path: Path) -> None:
    write_demo_report(tmp_path / "report.html", outcomes(tmp_path), COMMAND)
    html = (tmp_path / "report.html").read_text()
    assert_harmless(html, times=15)
    page = Page(html)
    assert {link for link in page.references() if not link.startswith(("data:", "#"))} == {"seen/report.html"}
    anchors = {str(attributes["id"]) for _, attributes in page.tags if "id" in attributes}
    links = [link[1:] for link in page.references() if re.match("#.", link)]
    assert links == ["step0", "step1", "step2"]
    assert set(links) <= anchors
    told = f"failed: {tmp_path}: holds {EVIL}", f"This step failed: {tmp_path}: holds {EVIL}"
    assert [page.text.count(text) for text in told] == [2, 1]  # in the loop, and in its section


def test_the_loop_has_seven_steps_in_order() -> None:
    titles = ["Record", "See", "Learn", "Drive", "Reconstruct", "Search", "Improve"]
    assert [step.title for step in STEPS] == titles
    assert all(line.startswith("foredrive ") for step in STEPS for line in step.commands)


@pytest.mark.parametrize("size", [full_demo(), quick_demo()])
def test_no_model_learns_from_the_town_that_it_is_judged_in(size: object) -> None:
    assert isinstance(size, type(full_demo()))
    assert {size.test.town, size.reconstructed.town} == {"Town05"}
    assert "Town05" not in {plan.town for plan in (*size.train, size.own, size.pool)}
    assert (size.own.town, size.own.seed) != (size.pool.town, size.pool.seed)
    searched = {route.id: route.town for route in load_route_set("training-short")}
    assert not {searched[route] for route in size.failing} & set(TEST_TOWNS)
    names = [plan.log_name for plan in Demo(size, Path()).plans]
    assert len(names) == len(set(names))
    assert size.route in [route.id for route in load_route_set("town05-short")]
    assert any(plan.conditions == "night" for plan in size.train)  # a text asks for it


def test_a_film_goes_into_a_page_as_it_is(tmp_path: Path) -> None:
    frames = [Image.new("RGB", (12, 8), (shade, 0, 0)) for shade in (0, 250)]
    frames[0].save(tmp_path / "film.webp", save_all=True, append_images=frames[1:])
    film = stored_film(tmp_path / "film.webp", "a film")
    assert (film.width, film.height, film.caption) == (12, 8, "a film")
    assert film.source.startswith("data:image/webp;base64,")
