"""The page that asks an index: what it answers, and what a browser makes of it."""

import http.client
import json
import shutil
import subprocess
import urllib.error
import urllib.parse
import urllib.request
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pyarrow as pa
import pytest
from html_pages import EVIL, Page, assert_harmless
from miniature import write_log
from small_towers import save_clip

from foredrive.data.clip_list import read_clip_list
from foredrive.runs.search.indexing import index_logs
from foredrive.search.find import Hit
from foredrive.search.index import FrameIndex
from foredrive.search.projection import project_scenes
from foredrive.search.query import Query
from foredrive.search.rows import FACTS, IndexRow
from foredrive.view.search_page import SearchPage, query_of
from foredrive.view.search_sheet import write_search_sheet

JSON = {"Content-Type": "application/json"}
MOMENTS = 3
"""Half a second apart, each with its whole and two views."""


@pytest.fixture(scope="module")
def page(tmp_path_factory: pytest.TempPathFactory) -> Iterator[SearchPage]:
    root = tmp_path_factory.mktemp("page")
    log = write_log(root, frames=11)
    index_logs([log], str(root / "index"), str(save_clip(root / "clip")), 0.5, 1)
    served = SearchPage(FrameIndex(str(root / "index")), None, "localhost", 0)
    with served.server.in_background():
        yield served


def fetch(page: SearchPage, path: str, body: object = None, **asked: object) -> Any:
    url = f"{page.url}{path}?{urllib.parse.urlencode(asked)}"
    data = None if body is None else json.dumps(body).encode()
    try:
        with urllib.request.urlopen(urllib.request.Request(url, data, JSON)) as answer:
            read = answer.read()
            return json.loads(read) if answer.headers["Content-Type"] == "application/json" else read
    except urllib.error.HTTPError as error:
        return json.load(error)


def test_a_text_has_hits_with_pictures(page: SearchPage) -> None:
    found = fetch(page, "/find", text="car at night", gap_s=0.4, top=2, view="sectors", modality="image")
    assert found["message"] == "2 hits, all compared"
    hit = found["hits"][0]
    assert hit["name"].startswith("flat_train/flat@")
    assert hit["score"].startswith("image ")
    assert fetch(page, "/picture", key=hit["key"]).startswith(b"\xff\xd8")


@pytest.mark.parametrize(
    ("asked", "why"),
    [
        ({}, "an empty query"),
        ({"where": "speed >>"}, "cannot be understood"),
        ({"text": "car", "modality": "radar"}, "modality: Input should be 'image', 'lidar'"),
        ({"text": "car", "top": "many"}, "top: Input should be a valid integer"),
        ({"text": "car", "top": str(10**30)}, "at most 1000 hits"),
        ({"text": "car", "gap_s": "nan"}, "gap at least 0 s"),
    ],
)
def test_what_cannot_be_asked_is_said(page: SearchPage, asked: dict[str, str], why: str) -> None:
    assert why in fetch(page, "/find", **asked)["detail"]
    assert "no GET /nowhere" in fetch(page, "/nowhere")["detail"]


@pytest.mark.parametrize(
    ("path", "body", "why"),
    [
        ("/moments", {"keys": []}, "nothing is selected"),
        ("/moments", {"keys": [7]}, "keys.0: Input should be a valid string"),
        ("/moments", {"keys": {"a": "b"}}, "keys: Input should be a valid list"),
        ("/moments", {"keys": ["nowhere|all"]}, "no scene 'nowhere|all'"),
        ("/moments", ["keys"], "dictionary"),
        ("/tag", {"tag": " ", "keys": []}, "a tag has a name"),
        ("/tag", {"tag": "late"}, "keys: Field required"),
        ("/clips", {"keys": ["a|all"], "before": "soon", "after": 1}, "before"),
        ("/clips", {"keys": ["a|all"], "before": -1, "after": 1}, "0 s or more"),
        ("/queries", {"name": 7, "asked": {}}, "name: Input should be a valid string"),
        ("/queries", {"name": "x", "asked": {"text": ["car"]}}, "asked.text"),
    ],
)
def test_what_is_no_message_of_the_page_is_said(page: SearchPage, path: str, body: object, why: str) -> None:
    assert why in fetch(page, path, body)["detail"]
    assert "no scene 'nowhere'" in fetch(page, "/picture", key="nowhere")["detail"]


@pytest.mark.parametrize(
    ("headers", "body", "status"),
    [
        ({"Host": "evil.example:80"}, None, 403),  # a name of somebody else that points here
        ({"Origin": "http://evil.example"}, None, 403),
        ({"Origin": "http://evil.example"}, b'{"name": "x", "asked": {"text": "car"}}', 403),
        ({"Origin": "null"}, b'{"name": "x", "asked": {"text": "car"}}', 403),
        ({"Content-Type": "text/plain"}, b'{"name": "x", "asked": {"text": "car"}}', 422),
        ({"Content-Length": "-1"}, b"{}", 400),
        ({"Content-Length": str(2**40)}, b"{}", 422),
        ({"Content-Length": "9" * 5000}, b"{}", 400),
        ({"Content-Length": "many"}, b"{}", 400),
        ({}, b"[" * 100_000, 422),
        ({}, b"{", 422),
    ],
)
def test_other_sites_and_long_or_broken_requests_are_refused(
    page: SearchPage, headers: dict[str, str], body: bytes | None, status: int
) -> None:
    before = fetch(page, "/queries")
    connection = http.client.HTTPConnection(urllib.parse.urlsplit(page.url).netloc, timeout=20)
    connection.request("GET" if body is None else "POST", "/queries", body, JSON | headers)
    answer = connection.getresponse()
    assert answer.status == status
    assert status == 400 or json.loads(answer.read())["detail"]  # 400: it is not HTTP
    connection.close()
    assert fetch(page, "/queries") == before


def test_the_pages_own_requests_are_answered(page: SearchPage) -> None:
    netloc = urllib.parse.urlsplit(page.url).netloc
    for name in (netloc, netloc.replace("localhost", "127.0.0.1")):
        connection = http.client.HTTPConnection(netloc, timeout=20)
        connection.request("GET", "/queries", headers={"Host": name, "Origin": f"http://{name}"})
        assert connection.getresponse().status == 200
        connection.close()


def test_scenes_in_a_lasso_are_shown_tagged_and_listed(page: SearchPage, tmp_path: Path) -> None:
    plane = fetch(page, "/map")
    assert (len(plane["points"]), plane["total"]) == (MOMENTS, MOMENTS)
    keys = [point["key"] for point in plane["points"][1:]]
    assert [hit["key"] for hit in fetch(page, "/moments", {"keys": keys})["hits"]] == keys
    assert fetch(page, "/tag", {"tag": "late", "keys": keys})["message"] == "2 moments are tagged late"
    assert len(fetch(page, "/find", tag="late", gap_s=0, view="all")["hits"]) == 2
    listed = tmp_path / "clips.json"
    listed.write_text(json.dumps(fetch(page, "/clips", {"keys": keys, "before": 0.25, "after": 1})))
    assert [clip.start_s for clip in read_clip_list(listed)] == pytest.approx([0.25, 0.75])


def test_queries_are_kept_and_come_back(page: SearchPage) -> None:
    asked = {"text": "rain", "top": "5", "gap_s": "2", "where": "", "rule": "features"}
    fetch(page, "/queries", {"name": "wet", "asked": asked})
    assert json.loads(fetch(page, "/queries")["wet"]) == json.loads(query_of(asked).to_json())


def test_the_plane_shows_where_scenes_vary_most(page: SearchPage) -> None:
    plane = project_scenes(page._index)
    assert abs(plane.xy).max(0) == pytest.approx([1.0, 1.0])
    assert plane.xy.mean(0) == pytest.approx([0.0, 0.0], abs=1e-5)
    assert plane.share == pytest.approx(1.0, abs=1e-5)  # three points always lie in a plane


def browse(url: str, profile: Path) -> Page:
    """The page as a browser leaves it."""
    flags = ["--headless", "--no-sandbox", "--disable-gpu", f"--user-data-dir={profile}"]
    done = subprocess.run(
        ["chromium", *flags, "--virtual-time-budget=20000", "--dump-dom", url],
        capture_output=True, text=True, timeout=120, check=True,
    )  # fmt: skip
    return Page(done.stdout)


@pytest.mark.skipif(shutil.which("chromium") is None, reason="there is no Chromium here")
def test_the_page_opens_with_scenes(page: SearchPage, tmp_path: Path) -> None:
    shown = browse(page.url, tmp_path)
    assert [tag for tag, _ in shown.tags].count("figure") == MOMENTS
    assert "3 of 3 whole scenes, evenly selected" in shown.text


@pytest.mark.skipif(shutil.which("chromium") is None, reason="there is no Chromium here")
def test_a_browser_draws_the_grid(page: SearchPage, tmp_path: Path) -> None:
    fetch(page, "/queries", {"name": EVIL, "asked": {"text": EVIL}})
    url = f"{page.url}/?" + urllib.parse.urlencode({"text": f"car {EVIL}", "top": 2, "gap_s": 0.4})
    shown = browse(url, tmp_path)
    assert [tag for tag, _ in shown.tags].count("figure") == 2
    assert "2 hits, all compared" in shown.text
    assert "3 of 3 whole scenes" in shown.text
    assert EVIL in shown.text  # the query that was kept
    assert "svg" not in {tag for tag, _ in shown.tags}


def index_row(**columns: str) -> IndexRow:
    """A row with these columns; most of the others are null."""
    texts = dict.fromkeys(("key", "log", "folder", "maps_dir", "view"), "-")
    row = {**texts, "t_s": 1.0, "t_us": 0, "frame": 0, **columns}
    return IndexRow.all_of(pa.Table.from_pylist([row], schema=FACTS))[0]


def test_names_from_outside_run_nothing_on_a_contact_sheet(tmp_path: Path) -> None:
    names = ("log", "folder", "maps_dir", "view", "place", "weather", "caption")
    row = index_row(**dict.fromkeys(names, EVIL))
    query = Query(text=EVIL, where=EVIL)
    write_search_sheet(tmp_path / "hits.html", query, [Hit(row, 0.5, {EVIL: 0.5})])
    # title and heading (text and condition), and of the hit: log, view, score, place, weather, caption
    assert_harmless((tmp_path / "hits.html").read_text(), times=4 + 6)


@pytest.mark.parametrize("unlike", [False, True])
def test_moments_that_are_no_hits_are_called_so(unlike: bool, tmp_path: Path) -> None:
    hit = Hit(index_row(folder="nowhere", maps_dir=""), 0.5, {})
    write_search_sheet(tmp_path / "hits.html", Query(text="snow"), [hit], unlike)
    assert ("no hits: the nearest moments" in (tmp_path / "hits.html").read_text()) is unlike


def test_a_query_with_dollars_is_no_formula(tmp_path: Path) -> None:
    hit = Hit(index_row(folder="$\\frac$", maps_dir=""), 0.5, {"$\\x$": 1.0})
    write_search_sheet(tmp_path / "hits.png", Query(text="5 $ or $\\frac$"), [hit])
    assert (tmp_path / "hits.png").stat().st_size > 1000
