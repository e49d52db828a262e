"""`zest explore` as people use it: the command, its page in a real browser, Ctrl-C."""

from __future__ import annotations

import base64
import io
import shlex
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from chromium import CHROMIUM
from PIL import Image

from zest_rl.data.reader import open_dataset

playwright = pytest.importorskip("playwright.sync_api")

WAIT = 300_000
"""Milliseconds that a busy machine may take."""
DROP = """([selector, pictures]) => {
  const transfer = new DataTransfer();
  pictures.forEach((data, i) => {
    const bytes = Uint8Array.from(atob(data), (letter) => letter.charCodeAt(0));
    transfer.items.add(new File([bytes], `${i}.png`, { type: "image/png" }));
  });
  document.querySelector(selector).dispatchEvent(new DragEvent("drop", { dataTransfer: transfer, bubbles: true }));
}"""
CURVES = "[...document.querySelectorAll('.cell path')].map((path) => path.getAttribute('d'))"


@pytest.fixture
def address(collected: str, embedded: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[str]:
    """Of the page of the tiny dataset, which `zest explore` serves until Ctrl-C."""
    shutil.copytree(embedded / "cache", tmp_path / "cache")
    monkeypatch.chdir(tmp_path)
    words = ["explore", collected, "--no-browser", "--views", "2", "--tolerance", "0.05", "--n-workers", "1"]
    code = (
        "import signal, sys; signal.signal(signal.SIGINT, signal.default_int_handler)\nfrom zest_rl.cli import main\n"
    )
    command = [sys.executable, "-c", f"{code}sys.exit(main())", *words]
    with subprocess.Popen(command, stderr=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as process:
        try:
            assert process.stderr is not None
            yield process.stderr.readline().strip()
            process.send_signal(signal.SIGINT)
            out, err = process.communicate(timeout=WAIT / 1000)
            assert (process.returncode, out) == (130, ""), err
            assert "Traceback" not in err
        finally:
            process.kill()


@pytest.fixture
def page(address: str) -> Iterator[Any]:
    """The page in Chromium, once it shows the episodes; what goes wrong in it fails the test."""
    if not CHROMIUM:
        pytest.skip("no chromium on PATH; install it to test the page in a browser (apt-get install chromium)")
    with playwright.sync_playwright() as driver:
        browser = driver.chromium.launch(executable_path=CHROMIUM, args=["--no-sandbox"])
        page = browser.new_page(viewport={"width": 1400, "height": 900}, color_scheme="dark")
        page.set_default_timeout(WAIT)
        problems = list[str]()
        page.on("pageerror", lambda error: problems.append(str(error)))
        page.on("console", lambda message: message.type == "error" and problems.append(message.text))
        page.goto(address)
        wait_until(page, "document.querySelectorAll('.cell').length === 4 && document.querySelector('#bar').hidden")
        yield page
        browser.close()
    assert problems == []


def wait_until(page: Any, expression: str) -> None:
    """Wait for what Playwright's own `wait_for_function` would evaluate in the page, whose policy forbids that."""
    deadline = time.monotonic() + WAIT / 1000
    while not page.evaluate(expression):
        assert time.monotonic() < deadline, expression
        page.wait_for_timeout(50)


def drop(page: Any, side: str, *pictures: np.ndarray) -> None:
    encoded = []
    for picture in pictures:
        buffer = io.BytesIO()
        Image.fromarray(picture).save(buffer, "PNG")
        encoded.append(base64.b64encode(buffer.getvalue()).decode())
    page.evaluate(DROP, [side, encoded])


def settled(page: Any) -> list[str]:
    """Wait until all answers are there, and return the curves."""
    wait_until(page, "!document.body.classList.contains('busy') && document.querySelector('#verdict').innerText")
    curves: list[str] = page.evaluate(CURVES)
    return curves


def shade(low: int, high: int) -> np.ndarray:
    return np.random.default_rng(low).integers(low, high, (64, 64, 3), dtype=np.uint8)


def test_pictures_that_are_dropped_and_frames_that_are_clicked_become_curves_and_a_dataset(
    page: Any, zest: Callable[..., dict[str, Any]]
) -> None:
    drop(page, "#starts", shade(0, 90))
    drop(page, "#goals", shade(120, 255), shade(60, 200))
    page.wait_for_selector(".cell path")
    page.wait_for_selector("#goals .held:nth-child(2)")
    by_drawings = settled(page)
    assert len(by_drawings) == 4

    page.click("#goals .held:nth-child(2) .picture")
    by_one_of_them = settled(page)
    assert by_one_of_them != by_drawings
    assert page.get_attribute("#goals .held:nth-child(2) .picture", "aria-pressed") == "false"

    page.click(".cell >> nth=0")
    page.focus("#episode .step")
    page.keyboard.press("End")
    page.click("#episode .take[data-side=goals]")
    page.wait_for_selector("#goals .held:nth-child(3)")
    by_a_frame = settled(page)
    assert by_a_frame != by_one_of_them
    wait_until(page, "document.querySelectorAll('.chart-of').length === 4")

    page.select_option("[name=features]", "raw")
    assert settled(page) != by_a_frame
    page.click("#save")
    page.wait_for_selector("#saved pre")
    name, command = page.inner_text("#saved b"), page.inner_text("#saved pre")
    page.wait_for_selector("#proposal pre", state="attached")
    assert page.text_content("#proposal pre") == f"zest curate {name}"
    (to_drop,) = page.evaluate("[...document.querySelectorAll('.dropped')].map((cell) => cell.dataset.episode)")
    assert page.text_content("#proposal tbody button") == to_drop
    with open_dataset(name) as ds:
        scores = ds.scores()
        path = ds.path
    shutil.rmtree(path)
    assert zest(*shlex.split(command)[1:])["dataset"] == name
    with open_dataset(name) as ds:
        assert all(map(np.array_equal, ds.scores(), scores))


def test_the_keyboard_walks_through_episodes_and_frames_and_a_narrow_page_fits(page: Any) -> None:
    opened = "document.querySelector('#episode h2').innerText"
    page.keyboard.press("j")
    wait_until(page, "document.querySelector('#episode img').naturalWidth === 224")
    assert page.evaluate(opened) == "Episode 0"
    page.keyboard.press("j")
    assert page.evaluate(opened) == "Episode 1"
    page.keyboard.press("k")
    assert page.evaluate(opened) == "Episode 0"
    for _ in range(3):
        page.keyboard.press("ArrowRight")
    page.keyboard.press("ArrowLeft")
    assert page.inner_text("#episode .at") == "step 2 of 100"
    page.keyboard.press("s")
    page.wait_for_selector("#starts .held")
    page.keyboard.press(" ")
    wait_until(page, "document.querySelector('#episode .step').value > 2")
    page.keyboard.press(" ")
    assert page.inner_text("#episode .play") == "▶ Play"

    page.set_viewport_size({"width": 400, "height": 800})
    assert page.evaluate("document.documentElement.scrollWidth") == 400
    dark = page.evaluate("getComputedStyle(document.body).backgroundColor")
    page.emulate_media(color_scheme="light")
    assert page.evaluate("getComputedStyle(document.body).backgroundColor") != dark
    page.keyboard.press("Escape")
    assert page.is_hidden("#episode")
