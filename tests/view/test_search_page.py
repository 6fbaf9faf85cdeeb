"""The page that asks an index: what it answers, and what a browser makes of it."""

import json
import shutil
import subprocess
import threading
import urllib.error
import urllib.parse
import urllib.request
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from miniature import write_log
from small_towers import save_clip

from foredrive.data.clip_list import read_clip_list
from foredrive.runs.search.indexing import index_logs
from foredrive.search.index import FrameIndex
from foredrive.search.projection import project_scenes
from foredrive.view.search_page import SearchPage, query_of

MOMENTS = 3
"""Half a second apart, each with its whole and two views."""


@pytest.fixture(scope="module")
def page(tmp_path_factory: pytest.TempPathFactory) -> Iterator[SearchPage]:
    root = tmp_path_factory.mktemp("page")
    log = write_log(root, frames=11)
    index_logs([log], str(root / "index"), str(save_clip(root / "clip")), 0.5, 1)
    served = SearchPage(FrameIndex(str(root / "index")), None, "localhost", 0)
    thread = threading.Thread(target=served.serve)
    thread.start()
    yield served
    served.close()
    thread.join()


def fetch(page: SearchPage, path: str, body: object = None, **asked: object) -> Any:
    url = f"{page.url}{path}?{urllib.parse.urlencode(asked)}"
    data = None if body is None else json.dumps(body).encode()
    try:
        with urllib.request.urlopen(urllib.request.Request(url, data)) as answer:
            read = answer.read()
            return json.loads(read) if answer.headers["Content-Type"] == "application/json" else read
    except urllib.error.HTTPError as error:
        return json.load(error)


def test_a_text_has_hits_with_pictures(page: SearchPage) -> None:
    found = fetch(page, "/find", text="car at night", gap_s=0.4, top=2, view="sectors", modality="image")
    assert found["told"] == "2 hits, all compared"
    hit = found["hits"][0]
    assert hit["name"].startswith("flat_train/flat@")
    assert hit["why"].startswith("image ")
    assert fetch(page, "/picture", key=hit["key"]).startswith(b"\xff\xd8")


@pytest.mark.parametrize(
    ("asked", "why"),
    [
        ({}, "an empty query"),
        ({"where": "speed >>"}, "cannot be understood"),
        ({"text": "car", "modality": "radar"}, "radar"),
        ({"text": "car", "top": "many"}, "many"),
    ],
)
def test_what_cannot_be_asked_is_said(page: SearchPage, asked: dict[str, str], why: str) -> None:
    assert why in fetch(page, "/find", **asked)["error"]
    assert "error" in fetch(page, "/nowhere")


def test_scenes_in_a_lasso_are_shown_tagged_and_listed(page: SearchPage, tmp_path: Path) -> None:
    plane = fetch(page, "/map")
    assert (len(plane["points"]), plane["total"]) == (MOMENTS, MOMENTS)
    keys = [point["key"] for point in plane["points"][1:]]
    assert [hit["key"] for hit in fetch(page, "/moments", {"keys": keys})["hits"]] == keys
    assert fetch(page, "/tag", {"tag": "late", "keys": keys})["told"] == "2 moments are tagged late"
    assert len(fetch(page, "/find", tag="late", gap_s=0, view="all")["hits"]) == 2
    assert "error" in fetch(page, "/tag", {"tag": " ", "keys": keys})
    listed = tmp_path / "clips.json"
    listed.write_text(json.dumps(fetch(page, "/clips", {"keys": keys, "before": 0.25, "after": 1})))
    assert [clip.start_s for clip in read_clip_list(listed)] == pytest.approx([0.25, 0.75])
    assert "error" in fetch(page, "/moments", {"keys": []})


def test_queries_are_kept_and_come_back(page: SearchPage) -> None:
    asked = {"text": "rain", "top": "5", "gap_s": "2", "where": "", "rule": "features"}
    fetch(page, "/queries", {"name": "wet", "asked": asked})
    assert json.loads(fetch(page, "/queries")["wet"]) == json.loads(query_of(asked).to_json())


def test_the_plane_shows_where_scenes_vary_most(page: SearchPage) -> None:
    plane = project_scenes(page._index)
    assert abs(plane.xy).max(0) == pytest.approx([1.0, 1.0])
    assert plane.xy.mean(0) == pytest.approx([0.0, 0.0], abs=1e-5)
    assert plane.share == pytest.approx(1.0, abs=1e-5)  # three points always lie in a plane


@pytest.mark.skipif(shutil.which("chromium") is None, reason="there is no Chromium here")
def test_a_browser_draws_the_grid(page: SearchPage, tmp_path: Path) -> None:
    url = f"{page.url}/?" + urllib.parse.urlencode({"text": "car", "top": 2, "gap_s": 0.4})
    flags = ["--headless", "--no-sandbox", "--disable-gpu", f"--user-data-dir={tmp_path}"]
    done = subprocess.run(
        ["chromium", *flags, "--virtual-time-budget=20000", "--dump-dom", url],
        capture_output=True, text=True, timeout=120, check=True,
    )  # fmt: skip
    assert done.stdout.count("<figure") == 2
    assert "2 hits, all compared" in done.stdout
    assert "3 of 3 whole scenes" in done.stdout
