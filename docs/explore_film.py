"""Makes the moving picture of docs/explore.md from the page itself, in Chromium::

zest explore zest/kitchen-sdoor-rl-v0 --tolerance 5e-3 --no-browser
python docs/explore_film.py ADDRESS START.png GOAL.png [docs/images/explore.webp]
"""

from __future__ import annotations

import io
import shutil
import sys
from collections.abc import Iterator
from pathlib import Path

from PIL import Image
from playwright.sync_api import Page, sync_playwright

SIZE, SCALE, QUALITY = (1200, 760), 0.7, 60
WAIT = 300_000
"""Milliseconds for an answer."""


def wait_until(page: Page, expression: str) -> None:
    """Wait; `wait_for_function` evaluates in the page, whose policy forbids that."""
    while not page.evaluate(expression):
        page.wait_for_timeout(50)


def scenes(page: Page, start: str, goal: str) -> Iterator[int]:
    """Use the page; yield after each change how many milliseconds it is shown."""
    wait_until(page, "document.querySelectorAll('.cell').length")
    yield 1200
    page.set_input_files("#starts input", start)
    page.wait_for_selector("#starts .held img")
    yield 900
    page.set_input_files("#goals input", goal)
    page.wait_for_selector(".cell path")
    wait_until(page, "document.querySelector('#verdict').innerText")
    yield 2600
    page.click("#proposal summary")
    page.select_option("#sort", "worth")
    page.wait_for_selector(".cell.dropped")
    yield 2600
    page.click("#proposal summary")
    page.click(".cell:has-text('✓') >> nth=0")
    last = int(page.get_attribute("#episode .step", "max") or 0)
    for step in range(0, last + 1, last // 12):
        page.fill("#episode .step", str(step))
        wait_until(page, "document.querySelector('#episode img').complete")
        wait_until(page, "document.querySelector('.chart-of')")
        yield 180
    yield 1200
    for side, step in (("goals", last), ("starts", 0)):
        page.fill("#episode .step", str(step))
        page.click(f"#episode .take[data-side={side}]")
        page.wait_for_selector(f"#{side} .held:nth-child(2)")
        page.click(f"#{side} .held:nth-child(1) .picture")
        wait_until(page, "!document.body.classList.contains('busy')")
        yield 2000
    page.fill("#episode .step", str(last))
    wait_until(page, "document.querySelector('#verdict').innerText")
    yield 3000


def main(address: str, start: str, goal: str, path: str = "docs/images/explore.webp") -> None:
    """Write the picture."""
    images, durations = [], []
    with sync_playwright() as driver:
        browser = driver.chromium.launch(executable_path=shutil.which("chromium"), args=["--no-sandbox"])
        page = browser.new_page(viewport={"width": SIZE[0], "height": SIZE[1]})
        page.set_default_timeout(WAIT)
        page.goto(address)
        for duration in scenes(page, start, goal):
            shot = Image.open(io.BytesIO(page.screenshot(timeout=WAIT))).convert("RGB")
            images.append(shot.resize([round(SCALE * side) for side in SIZE], Image.Resampling.LANCZOS))
            durations.append(duration)
        browser.close()
    images[0].save(path, save_all=True, append_images=images[1:], duration=durations, loop=0, quality=QUALITY)
    print(f"{path}: {len(images)} pictures, {Path(path).stat().st_size // 1000} kB")


if __name__ == "__main__":
    main(*sys.argv[1:])
