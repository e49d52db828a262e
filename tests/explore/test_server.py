"""The page's server, spoken to over HTTP: what it scores, what it saves, and whom it answers."""

from __future__ import annotations

import io
import shlex
import shutil
from collections.abc import Callable, Iterator
from concurrent.futures import Executor
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from few_states import OPTIONS
from hugging_face_files import save_hugging_face
from PIL import Image
from starlette.testclient import TestClient

from zest_rl.analysis.inspection import inspect
from zest_rl.cli import curate, relabel
from zest_rl.cli.arguments import words_of
from zest_rl.data.reader import open_dataset
from zest_rl.explore import shelf as shelves
from zest_rl.explore.background import Choice
from zest_rl.explore.films import drawing_thread
from zest_rl.explore.server import MAX_PICTURE, Page, make_app
from zest_rl.explore.session import Session
from zest_rl.explore.shelf import Shelf
from zest_rl.rewards.embeddings import shared_embedder
from zest_rl.rewards.goals import read_folder

TOKEN, HOST = "a-token", "127.0.0.1:8000"
JSON = {"content-type": "application/json"}


def command(verb: str, arguments: Any) -> str:
    config_class = {"relabel": relabel.Config, "curate": curate.Config}[verb]
    return shlex.join(["zest", verb, *words_of(config_class(**arguments))])


def open_page(dataset: str, folder: Path, studio: Executor, options: dict[str, Any] = OPTIONS) -> Page:
    choice = Choice(dataset, options)
    shelf = Shelf(shared_embedder(*choice.embedding.values()))
    session = Session(choice, shelf, lambda: (1.0, ""))
    return Page([session], shelf, studio, folder / "goals", command)


@pytest.fixture
def page(collected: str, embedded: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Page]:
    """The page of the tiny dataset, all of which is embedded."""
    shutil.copytree(embedded / "cache", tmp_path / "cache")
    monkeypatch.chdir(tmp_path)
    with drawing_thread() as studio:
        yield open_page(collected, tmp_path, studio)


@pytest.fixture
def client(page: Page) -> TestClient:
    return TestClient(make_app(page, TOKEN, [HOST]), base_url=f"http://{HOST}/{TOKEN}/")


def drop(client: TestClient, picture: np.ndarray) -> str:
    buffer = io.BytesIO()
    Image.fromarray(picture).save(buffer, "PNG")
    (name,) = client.post("pictures", content=buffer.getvalue(), headers={"content-type": "image/png"}).json()["names"]
    return str(name)


def ask(client: TestClient, **changed: Any) -> dict[str, Any]:
    """A goal of two pictures of the start and one of the end, from episode 0."""
    assert client.get("state/0").json()["ready"] == 4
    (start,) = client.post("take/0/0/0", json={"view": 0}).json()["names"]
    ends = client.post("take/0/0/100", json={"view": None}).json()["names"]
    return {"starts": [start], "goals": ends, **changed}


@pytest.mark.parametrize(
    "settings",
    [{"goal_share": 1}, {"features": "progress", "reward": "difference"}, {"similarity": "l2", "goal_share": 0.5}],
    ids=["delta", "progress", "half of the goals"],
)
def test_what_is_saved_are_the_scores_shown_and_the_very_dataset_of_the_command_that_is_printed(
    client: TestClient, page: Page, settings: dict[str, Any], zest: Callable[..., dict[str, Any]]
) -> None:
    asked = ask(client, **settings)
    shown = client.post("scores/0", json=asked).json()
    verdict = client.post("verdict/0", json=asked).json()
    saved = client.post("save/0", json=asked).json()
    with open_dataset(saved["dataset"]) as ds:
        scores, rewards, path = ds.scores(), ds.rewards(), ds.path
    for each, score, reward in zip(shown["episodes"], scores, rewards, strict=True):
        np.testing.assert_allclose(each["curve"], score, atol=2e-5)
        assert each["return"] == pytest.approx(reward.sum(), abs=1e-3)
    inspected = inspect(saved["dataset"])
    assert (verdict["advice"], verdict["why"]) == (inspected.verdict.advice, inspected.verdict.why)
    assert verdict["warnings"] == list(inspected.warnings)

    path.rename(path.with_name("as-the-page-saved-it"))
    words = shlex.split(saved["command"])
    assert zest(*words[1:])["dataset"] == saved["dataset"]
    with open_dataset(saved["dataset"]) as ds:
        assert all(map(np.array_equal, ds.scores(), scores))
        assert all(map(np.array_equal, ds.rewards(), rewards))


def test_the_episodes_to_drop_are_those_of_the_curate_command_that_is_printed(
    client: TestClient, zest: Callable[..., dict[str, Any]]
) -> None:
    asked = ask(client)
    proposed = client.post("proposal/0", json={**asked, "keep": 0.5}).json()
    assert proposed["command"] is None, "nothing is relabeled yet"
    saved = client.post("save/0", json=asked).json()["dataset"]
    command = client.post("proposal/0", json={**asked, "keep": 0.5}).json()["command"]
    assert command == f"zest curate {saved} --keep 0.5"
    curated = zest(*shlex.split(command)[1:], "--dry-run")
    assert proposed["dropped"] == curated["dropped"]
    shown = {each["episode"]: each for each in client.post("scores/0", json=asked).json()["episodes"]}
    for row in curated["episodes"]:
        assert shown[row["episode"]]["words"] == row["words"]
        assert shown[row["episode"]]["worth"] == pytest.approx(row["worth"], abs=1e-5)
    assert client.post("proposal/0", json={**asked, "keep": 1}).json() == {"dropped": [], "command": None}
    for unfit in (0, 1.5, "0.8", None):
        assert "keep must be" in client.post("proposal/0", json={**asked, "keep": unfit}).json()["error"]


def test_two_sentences_score_as_the_command_that_is_printed(
    collected: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, zest: Callable[..., dict[str, Any]]
) -> None:
    folder = tmp_path / "clip"
    folder.mkdir()
    save_hugging_face("clip", folder)
    monkeypatch.chdir(tmp_path)
    options = {**OPTIONS, "tolerance": 0.3, "embedder": f"transformers:{folder}", "n_workers": 1}
    Choice(collected, options).find()[1].embed()
    asked = {"starts": ["closed microwave"], "goals": ["open microwave"], "are_sentences": True}
    with drawing_thread() as studio:
        page = open_page(collected, tmp_path, studio, options)
        client = TestClient(make_app(page, TOKEN, [HOST]), base_url=f"http://{HOST}/{TOKEN}/")
        assert client.get("state/0").json()["reads_text"]
        shown = client.post("scores/0", json=asked).json()["episodes"]
        saved = client.post("save/0", json=asked).json()
    assert "--goal 'text:closed microwave -> open microwave'" in saved["command"]
    with open_dataset(saved["dataset"]) as ds:
        scores, path = ds.scores(), ds.path
    for each, score in zip(shown, scores, strict=True):
        np.testing.assert_allclose(each["curve"], score, atol=2e-5)
    path.rename(path.with_name("as-the-page-saved-it"))
    assert zest(*shlex.split(saved["command"])[1:])["dataset"] == saved["dataset"]
    with open_dataset(saved["dataset"]) as ds:
        assert all(map(np.array_equal, ds.scores(), scores))


def test_each_goal_and_each_view_has_its_own_curve_and_a_goal_that_is_switched_off_counts_no_more(
    client: TestClient,
) -> None:
    asked = ask(client)
    all_on = client.post("curves/0/0", json=asked).json()
    n_views = len(client.get("state/0").json()["views"])
    assert (len(all_on["by_goal"]), len(all_on["by_view"])) == (len(asked["goals"]), n_views)
    np.testing.assert_allclose(np.mean(all_on["by_goal"], axis=0), all_on["scores"], atol=2e-5)
    np.testing.assert_allclose(np.mean(all_on["by_view"], axis=0), all_on["scores"], atol=2e-5)
    one_off = client.post("curves/0/0", json={**asked, "goals": asked["goals"][:1]}).json()
    np.testing.assert_allclose(one_off["scores"], all_on["by_goal"][0], atol=2e-5)
    assert all_on["truth"][0] is None
    assert len(all_on["truth"]) == len(all_on["scores"]) == 101


def test_a_goal_that_is_saved_holds_the_pictures_that_were_dropped_to_the_pixel(client: TestClient, page: Page) -> None:
    rng = np.random.default_rng(0)
    pictures = [rng.integers(0, 255, (40, 50, 3), dtype=np.uint8) for _ in range(2)]
    start, end = (drop(client, picture) for picture in pictures)
    saved = client.post("goal/0", json={"starts": [start], "goals": [end]}).json()
    read = read_folder(Path(saved["goal"]))
    assert np.array_equal(read.starts[0], pictures[0])
    assert np.array_equal(read.goals[0], pictures[1])
    assert saved["goal"] in saved["command"]
    assert client.post("goal/0", json={"starts": [start], "goals": [end]}).json() == saved, "again, nothing changes"


def test_frames_are_shown_and_taken_as_the_scorer_sees_them(client: TestClient, page: Page) -> None:
    jpeg = client.get("frames/0/1/100/1")
    shown = np.asarray(Image.open(io.BytesIO(jpeg.content)), np.float64)
    (name,) = client.post("take/0/1/100", json={"view": 1}).json()["names"]
    taken = page.shelf.picture(name)
    assert taken.shape == shown.shape == (224, 224, 3)
    assert np.abs(taken - shown).mean() < 4
    small = Image.open(io.BytesIO(client.get(f"pictures/{name}").content))
    assert np.array_equal(np.asarray(small), taken)


def test_the_episodes_that_are_embedded_can_be_scored_while_others_are_not(
    collected: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    with drawing_thread() as studio:
        page = open_page(collected, tmp_path, studio)
        client = TestClient(make_app(page, TOKEN, [HOST]), base_url=f"http://{HOST}/{TOKEN}/")
        assert client.get("state/0").json()["ready"] == 0
        next(iter(page.sessions[0]._embeddings))
        assert client.get("state/0").json()["ready"] == 1
        (start,) = client.post("take/0/0/0", json={"view": 0}).json()["names"]
        (end,) = client.post("take/0/0/100", json={"view": 0}).json()["names"]
        asked = {"starts": [start], "goals": [end]}
        assert [each["episode"] for each in client.post("scores/0", json=asked).json()["episodes"]] == [0]
        assert client.post("verdict/0", json=asked).json() == {"advice": None}
        refused = client.post("save/0", json=asked)
        assert (refused.status_code, "wait a moment" in refused.json()["error"]) == (400, True)
        assert "not embedded yet" in client.post("curves/0/3", json=asked).json()["error"]


@pytest.mark.parametrize(
    ("address", "headers", "status"),
    [
        (f"http://{HOST}/{TOKEN}/", {}, 200),
        (f"http://{HOST}/{TOKEN}/", {"origin": f"http://{HOST}"}, 200),
        (f"http://{HOST}/another-token/", {}, 404),
        (f"http://{HOST}/", {}, 404),
        (f"http://{HOST}/state/0", {}, 404),
        (f"http://{HOST}/{TOKEN}/", {"host": "evil.example:8000"}, 403),
        (f"http://{HOST}/{TOKEN}/", {"host": "127.0.0.1:8001"}, 403),
        (f"http://{HOST}/{TOKEN}/", {"origin": "http://evil.example"}, 403),
        (f"http://{HOST}/{TOKEN}/", {"origin": "null"}, 403),
    ],
)
def test_only_its_own_page_on_this_machine_with_the_token_is_answered(
    client: TestClient, address: str, headers: dict[str, str], status: int
) -> None:
    assert client.get(address, headers=headers).status_code == status


def test_nothing_from_elsewhere_runs_on_the_page_and_the_token_goes_nowhere(client: TestClient) -> None:
    headers = client.get("").headers
    policy = dict(part.split(" ", 1) for part in headers["content-security-policy"].split("; "))
    assert policy["default-src"] == "'none'"
    assert policy["script-src"] == policy["style-src"] == policy["connect-src"] == "'self'"
    assert policy["frame-ancestors"] == "'none'"
    assert headers["referrer-policy"] == "no-referrer"
    assert "access-control-allow-origin" not in headers


@pytest.mark.parametrize(
    ("content", "kind", "status", "message"),
    [
        (b"GIF89a", "text/html", 415, "only pictures"),
        (b"", "image/png", 400, "not an image"),
        (b"%!PS-Adobe-3.0 EPSF-3.0", "image/eps", 400, "not an image"),
        (b"<svg xmlns='http://www.w3.org/2000/svg'/>", "image/svg+xml", 400, "not an image"),
        (bytes(MAX_PICTURE + 1), "image/png", 413, "at most 40 MB"),
    ],
    ids=["text", "empty", "EPS", "SVG", "large"],
)
def test_what_is_dropped_and_no_picture_that_the_package_reads_is_refused(
    client: TestClient, content: bytes, kind: str, status: int, message: str
) -> None:
    answer = client.post("pictures", content=content, headers={"content-type": kind})
    assert answer.status_code == status
    assert message in answer.json()["error"]


def test_pictures_do_not_fill_the_memory(client: TestClient, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(shelves, "MAX_BYTES", 10_000)
    drop(client, np.zeros((40, 40, 3), np.uint8))
    drop(client, np.zeros((40, 40, 3), np.uint8))  # is there already
    image = io.BytesIO()
    Image.new("RGB", (50, 50)).save(image, "PNG")
    refused = client.post("pictures", content=image.getvalue(), headers={"content-type": "image/png"})
    assert "all pictures together" in refused.json()["error"]


@pytest.mark.parametrize(
    "path",
    [
        "frames/0/4/0/0", "frames/0/0/101/0", "frames/0/0/0/2", "frames/1/0/0/0", "frames/0/-1/0/0", "state/1",
        "frames/0/0/0/..%2f..%2fetc%2fpasswd", "..%2f..%2fserver.py", "pages/x", "server.py", "page.html",
    ],
)  # fmt: skip
def test_an_address_leads_to_frames_of_the_dataset_and_to_no_file(client: TestClient, path: str) -> None:
    assert client.get(path).status_code == 404


@pytest.mark.parametrize(
    ("asked", "message"),
    [
        (b"{", "no JSON"),
        (b"[1]", "a JSON object"),
        (b'{"starts": ["x"]}', "this is no goal"),
        (b'{"starts": ["x"], "goals": "y"}', "goals must be"),
        (b'{"starts": ["x"], "goals": ["y"], "output": "/etc"}', "this is no goal"),
        (b'{"starts": [], "goals": ["y"]}', "at least one picture"),
        (b'{"starts": ["../../etc/passwd"], "goals": ["y"]}', "not known any more"),
        (b'{"starts": ["x"], "goals": ["y"], "features": "best"}', "features must be"),
        (b'{"starts": ["x"], "goals": ["y"], "goal_share": 2}', "goal_share"),
        (b'{"starts": ["x"], "goals": ["y"], "are_sentences": true}', "reads pictures only"),
        (b'{"starts": ["x -> z"], "goals": ["y"], "are_sentences": true}', "neither | nor ->"),
    ],
)
@pytest.mark.parametrize("verb", ["scores/0", "save/0"])
def test_a_question_that_makes_no_sense_is_refused_with_a_reason(
    client: TestClient, asked: bytes, message: str, verb: str
) -> None:
    client.get("state/0")
    answer = client.post(verb, content=asked, headers=JSON)
    assert answer.status_code == 400
    assert message in answer.json()["error"]
    assert client.post(verb, content=b"{}", headers={"content-type": "text/plain"}).status_code == 415
