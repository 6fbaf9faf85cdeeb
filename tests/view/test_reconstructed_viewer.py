"""The page of a reconstructed log: what is on it, what its controls do, what it says of faults."""

import contextlib
import dataclasses
import threading
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import synthetic_log as world
import torch

from foredrive.cli.main import main
from foredrive.errors import InputError
from foredrive.methods.reconstruction.edits import Move, Remove, ShiftEgo, load_edits, move_between
from foredrive.methods.reconstruction.tracks import states_at
from foredrive.methods.splatad import Gaussians
from foredrive.runs.reconstruction.reconstruct import Reconstruction
from foredrive.runs.reconstruction.reconstruction_run import OpenedReconstruction, open_reconstruction
from foredrive.view.reconstruction_nodes import thin_out
from foredrive.view.reconstruction_viewer import JobRunner, ReconstructedViewer

PARKED, MOVING = 7, 11


@pytest.fixture(scope="module")
def run(small_run: Reconstruction) -> OpenedReconstruction:
    return open_reconstruction(small_run.folder)


class Page(ReconstructedViewer):
    """Keeps what it said."""

    def __init__(self, *args: object) -> None:
        self.said: list[str] = []
        super().__init__(*args)  # type: ignore[arg-type]

    def tell(self, message: str) -> None:
        self.said.append(message)


@pytest.fixture
def page(run: OpenedReconstruction, tmp_path: Path) -> Iterator[Page]:
    page = Page(run, [], tmp_path / "edits.json", "localhost", 0)
    yield page
    page.close()


def node(page: ReconstructedViewer, name: str):
    return page.server.scene.get_handle_by_name(name)


def picture(page: ReconstructedViewer) -> np.ndarray:
    page.jobs.wait()
    return page.pictures.images[0].image.astype(int)


def test_what_is_drawn_is_where_it_is_then(page: Page, run: OpenedReconstruction) -> None:
    for t_s in (0.0, 0.3):
        page.show(t_s)
        ego_m = world.EGO_SPEED_MPS * t_s
        assert node(page, "/scene").position == pytest.approx((-ego_m, 0, 0), abs=0.02)
        moved = node(page, f"/scene/actors/{MOVING}").position
        assert moved == pytest.approx(world.MOVING["centre"] + [world.MOVING["speed"] * t_s, 0, 0], abs=0.1)
    assert node(page, f"/scene/actors/{MOVING}/face").dimensions == pytest.approx((4, 2, 2), abs=0.05)
    page.jobs.wait()
    assert np.ptp(node(page, "/lidar").points[:, 0]) > 5
    assert node(page, "/cameras/ahead").position == pytest.approx((1.6, 0, 1.5), abs=1e-3)


def test_pictures_follow_time_and_edits(page: Page) -> None:
    before = picture(page)
    page.edits.choose(MOVING)
    assert page.edits.gizmo.visible
    page.edits._change("remove")
    assert page.edits.chosen is None
    assert not page.edits.gizmo.visible
    assert node(page, f"/scene/actors/{MOVING}") is None
    removed = picture(page)
    assert np.abs(removed - before).max() > 8
    page.edits._shift()  # by 2 m, unless the page says otherwise
    assert node(page, "/scene").position == pytest.approx((0, -2, 0), abs=1e-4)
    assert np.abs(picture(page) - removed).mean() > 1
    assert page.edits.edits == [Remove(MOVING), ShiftEgo((0.0, 2.0, 0.0))]
    page.edits._undo()
    page.edits._undo()
    assert page.edits.undo.disabled
    assert np.array_equal(picture(page), before)


def test_an_actor_stays_where_it_is_dragged(page: Page) -> None:
    page.show(0.2)
    page.edits.choose(PARKED)
    start = np.array(page.edits.gizmo.position)
    page.edits.gizmo.position = start + np.array([2.0, -1.0, 0.0])
    page.edits._drag()
    assert node(page, f"/scene/actors/{PARKED}").position == pytest.approx(
        start + np.array([2.0, -1.0, 0.0]), abs=1e-4
    )
    assert page.edits.edits == []  # not before it is let go
    page.edits.drop()
    (move,) = page.edits.edits
    assert isinstance(move, Move)
    assert move.offset_m == pytest.approx((2.0, -1.0, 0.0), abs=1e-3)
    page.show(0.4)
    assert node(page, f"/scene/actors/{PARKED}").position == pytest.approx(
        start + np.array([2.0, -1.0, 0.0]), abs=0.05
    )


def test_an_actor_is_moved_by_numbers_in_its_own_frame(page: Page) -> None:
    page.show(0.2)
    page.edits.choose(PARKED)
    start = np.array(page.edits.gizmo.position)
    page.edits.by.value = (2.0, -1.0, 90.0)
    page.edits._change("move")
    page.edits._change("move")  # ahead is to the left of where it was
    assert node(page, f"/scene/actors/{PARKED}").position == pytest.approx(
        start + np.array([3.0, 1.0, 0.0]), abs=1e-3
    )


def test_an_actor_may_be_removed_while_the_log_plays(page: Page, monkeypatch: pytest.MonkeyPatch) -> None:
    """One thread waits in the middle of drawing until the other edits, unless they keep each other out."""
    both, draw = threading.Barrier(2), page.nodes.show

    def meet(*_: object) -> None:
        with contextlib.suppress(threading.BrokenBarrierError):
            both.wait(timeout=1.0)

    def draw_together(*args: Any) -> None:
        meet()
        draw(*args)

    monkeypatch.setattr(page.nodes, "show", draw_together)
    page.edits.actor.on_update(meet)  # called while the list of actors is set anew
    steps = (partial(page.show, 0.2), partial(page.edits.add, Remove(MOVING)))
    threads = [threading.Thread(target=step, daemon=True) for step in steps]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join(timeout=30.0)
    assert [thread.is_alive() for thread in threads] == [False, False]
    assert page.edits.edits == [Remove(MOVING)]
    assert node(page, f"/scene/actors/{MOVING}") is None
    assert node(page, "/scene").position[0] == pytest.approx(-0.2 * world.EGO_SPEED_MPS, abs=0.02)


def test_copies_are_chosen_and_have_ids_of_their_own(page: Page, run: OpenedReconstruction) -> None:
    page.edits.choose(PARKED)
    page.edits._change("duplicate")
    assert page.edits.chosen == MOVING + 1
    page.edits.source.value, page.edits.source_id.value = str(run.folder), MOVING
    page.edits._insert()
    assert page.edits.chosen == MOVING + 2
    assert page.said == []
    aside = (
        node(page, f"/scene/actors/{MOVING + 1}").position - node(page, f"/scene/actors/{PARKED}").position
    )
    assert aside == pytest.approx((0, 3, 0), abs=1e-3)


def test_saved_edits_begin_another_page_with_the_same_picture(page: Page, run: OpenedReconstruction) -> None:
    page.edits.replace([Remove(MOVING), Move(PARKED, (1.0, 0.5, 0.0), 0.4), ShiftEgo((0.0, 1.0, 0.0))])
    page.edits.save()
    file = Path(page.edits.file.value)
    again = Page(run, load_edits(file), file, "localhost", 0)
    assert np.array_equal(picture(again), picture(page))
    again.edits.replace([])
    again.edits.load()
    assert np.array_equal(picture(again), picture(page))
    again.close()


def test_what_cannot_be_done_is_told_and_changes_nothing(
    page: Page, run: OpenedReconstruction, tmp_path: Path
) -> None:
    file = Path(page.edits.file.value)
    page.edits._change("remove")
    page.edits.replace([Remove(99)])
    page.edits.choose(PARKED)
    page.edits.source.value = str(tmp_path)
    page.edits._insert()
    page.edits.load()
    file.write_text('{"name": "something else"}')
    page.edits.save()
    assert file.read_text() == '{"name": "something else"}'
    expected = (
        "choose an actor",
        "no actor 99; there are",
        "not a reconstruction folder",
        "cannot be read",
        "not a list",
    )
    assert len(page.said) == len(expected)
    for said, part in zip(page.said, expected, strict=True):
        assert part in said
    assert page.edits.edits == []


def test_a_job_gives_way_to_a_newer_one_and_none_starves() -> None:
    done: list[str] = []
    told: list[str] = []
    jobs = JobRunner(told.append)
    begin, begun = threading.Event(), threading.Event()

    def first() -> None:
        begun.set()
        begin.wait()
        done.append("a0")

    jobs.submit("a", first)
    begun.wait()
    for k in range(1, 4):
        jobs.submit("a", lambda k=k: done.append(f"a{k}"))
    jobs.submit("b", lambda: done.append("b"))

    def fails() -> None:
        raise InputError("it cannot be done")

    jobs.submit("c", fails)
    begin.set()
    jobs.wait()
    assert done == ["a0", "b", "a3"]  # the other name first: "a" had its turn
    assert told == ["it cannot be done"]
    jobs.close()


def test_of_too_many_splats_those_that_cover_most_are_left() -> None:
    four = Gaussians(
        mean_m=torch.arange(4.0)[:, None].expand(4, 3),
        quaternion=torch.tensor([[1.0, 0, 0, 0]]).expand(4, 4),
        log_scale=torch.tensor([[1.0, 1, 1], [0.1, 0.1, 3], [1, 1, 0.01], [9, 9, 9]]).log(),
        opacity_logit=torch.tensor([0.1, 0.9, 0.9, 0.001]).logit(),
        feature=torch.zeros(4, 3),
    )
    here = torch.zeros(1, 3)
    assert thin_out(four, 1.0, here).mean_m[:, 0].tolist() == [0, 1, 2]  # the last is too faint to be seen
    assert thin_out(four, 0.5, here).mean_m[:, 0].tolist() == [1, 2]  # 0.9 · 0.3 and 0.9 · 1 beside 0.1 · 1
    there = torch.tensor([[1.0, 1.0, 1.0], [-30.0, 0.0, 0.0]])
    far = dataclasses.replace(four, mean_m=four.mean_m * torch.tensor([1.0, 1.0, 100.0, 1.0])[:, None])
    assert thin_out(far, 0.5, there).mean_m[:, 0].tolist() == [0, 1]  # the third is 345 m away


def test_a_move_is_read_off_two_poses(run: OpenedReconstruction) -> None:
    tracks = run.scene.tracks
    before = states_at(tracks, 0.2).T_scene_actor[tracks.index_of(MOVING)].detach()
    move = Move(MOVING, (1.0, -2.0, 0.0), 0.3)
    turned = torch.eye(4)
    turned[:2, :2] = torch.tensor([[np.cos(0.3), -np.sin(0.3)], [np.sin(0.3), np.cos(0.3)]])
    turned[:3, 3] = torch.tensor(move.offset_m)
    found = move_between(MOVING, before, before @ turned)
    assert found.offset_m == pytest.approx(move.offset_m, abs=1e-5)
    assert found.yaw_rad == pytest.approx(0.3, abs=1e-6)


@pytest.mark.parametrize(
    ("flags", "said"),
    [
        (["--edits", "{tmp}/none.json"], "none.json: no such file"),
        (["--edits", "{tmp}/other.json"], "no actor 99; there are"),
        (["--t", "7"], "7 s is not in the log"),
        (["--save", "{tmp}/x.png"], "--run and --save need a log"),
        (["--port", "70000"], "--port must be a number from 1 to 65535, got 70000"),
    ],
)
def test_what_cannot_be_opened_is_one_line(
    flags: list[str], said: str, run: OpenedReconstruction, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "other.json").write_text('[{"kind": "remove", "actor": 99}]')
    assert main(["view", str(run.folder), *(flag.format(tmp=tmp_path) for flag in flags)]) == 2
    err = capsys.readouterr().err
    assert err.count("\n") == 1
    assert said in err


def test_an_unfinished_run_is_told(
    run: OpenedReconstruction, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "config.yaml").write_bytes((run.folder / "config.yaml").read_bytes())
    assert main(["view", str(tmp_path)]) == 2
    assert "not finished; continue it with `foredrive reconstruct`" in capsys.readouterr().err
