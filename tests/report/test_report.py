"""The report: what stands in the page, what never does, and how it behaves in a real browser."""

from __future__ import annotations

import base64
import dataclasses
import itertools
import json
import os
import re
import subprocess
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import imageio.v2 as imageio
import numpy as np
import pytest
from chromium import CHROMIUM
from hypothesis import given
from hypothesis import strategies as st
from markupsafe import escape

from zest_rl.errors import BadInput
from zest_rl.report.charts import axis_over, correlation_gauge, interval_bar, results_axis
from zest_rl.report.content import (
    EpisodePanel,
    GoalPanel,
    MethodRow,
    QualityRow,
    QualityTable,
    Scatter,
    ScoreMatrix,
    Series,
    Strip,
    TaskTable,
)
from zest_rl.report.html import render_html, write_report
from zest_rl.report.sections import (
    CAVEATS,
    DETAILS,
    EPISODES,
    FRAMES,
    GOALS,
    LEARNING_CURVES,
    PIXELS,
    RANKING,
    RESULTS,
    REWARD_QUALITY,
    SCORES_OVER_TIME,
    SUB_GOALS,
    TASK_TABLES,
    TASKS_AGAINST_GOALS,
    VIEWS,
    WARNINGS,
    Report,
    Section,
    SectionKind,
)

N_STEPS = 30
FPS = 10.0
GREY, GREY_PER_STEP = 40, 6


def write_video(path: Path, codec: str = "libx264") -> Path:
    """Write one frame per step, each brighter than the one before."""
    frames = [np.full((64, 64, 3), GREY + GREY_PER_STEP * step, np.uint8) for step in range(N_STEPS + 1)]
    imageio.mimwrite(path, frames, fps=FPS, codec=codec)
    return path


@pytest.fixture(scope="module")
def video(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_video(tmp_path_factory.mktemp("video") / "episode.mp4")


@pytest.fixture
def report(video: Path) -> Report:
    rng = np.random.default_rng(0)
    progress = np.linspace(0, 1, N_STEPS + 1, dtype=np.float32)
    scores = (0.8 * progress + 0.05 * rng.normal(size=N_STEPS + 1)).astype(np.float32)
    returns = rng.uniform(0, 100, 12).astype(np.float32)
    steps = np.arange(0, 500, 100, dtype=np.float32)
    image = rng.integers(0, 255, (240, 320, 3), dtype=np.uint8)
    episode = EpisodePanel("an episode", "ZeST+DT", 7, 93.21, True, video, FPS, progress, scores)
    means = np.array([[0.61, 0.2, 0.3], [0.1, 0.43, 0.09]], np.float32)
    rows = (
        MethodRow("ZeST+DT", 62.34, 55.1, 69.0, 63.0, 0.61, 3, 150, paper_value=66.6),
        MethodRow("shuffled scores", 12.0, 8.0, 15.0, 11.0, 0.1, 3, 150, kind="control", note="must be worse"),
    )
    quality = (
        QualityRow("rank correlation", "1 is best", ((0.71, 0.6, 0.8), None)),
        QualityRow("a share", "of frames", ((0.25, float("nan"), float("nan")), (0.5, 0.4, 0.6))),
    )
    goals = (
        GoalPanel("internet images", (image,), (image, image), 0.79, 300),
        GoalPanel("sentences", ("closed microwave",), ("open microwave",)),
    )
    pixels = Scatter("change", steps[:3], steps[:3], 1.0, y_name="a score", x_name="pixels", point="step")
    return Report(
        "Microwave",
        "The reward ranks episodes.",
        (
            RESULTS(rows),
            TASK_TABLES((TaskTable("one task", rows, "#task"),)),
            CAVEATS(("three seeds only",)),
            WARNINGS(("the reward is a clock",)),
            REWARD_QUALITY((QualityTable(("delta", "raw"), quality),)),
            TASKS_AGAINST_GOALS(
                (
                    ScoreMatrix(
                        ("door", "knob"),
                        ("delta", "raw", "text"),
                        means,
                        means - np.float32(0.02),
                        means + np.float32(0.03),
                    ),
                )
            ),
            GOALS(goals),
            RANKING((Scatter("delta cos", returns, returns / 2, 0.83, (0.71, 0.9)),)),
            FRAMES((Strip("the best", (image, image), (0, 30), np.array([0.0, 1.2], np.float32)),)),
            VIEWS((Series("all views", "score", steps, steps), Series("view 1", "score", steps, 2 * steps))),
            PIXELS((pixels,)),
            SCORES_OVER_TIME((Series("successes", "mean reward", steps, steps),)),
            SUB_GOALS((Series("open", "similarity", steps, steps),)),
            EPISODES((episode, dataclasses.replace(episode, title="not scored", scores=None, success=False))),
            LEARNING_CURVES(
                (
                    Series("BC", "loss", steps, 1 / (1 + steps)),
                    Series("DT", "loss", steps, steps, (steps - 1, steps + 1)),
                )
            ),
            DETAILS((("config", {"lr": 1e-4, "folder": Path("runs/a")}),)),
        ),
    )


def with_sections(report: Report, *sections: Section[Any]) -> Report:
    """Return the report with other sections of the same kinds."""
    new = {section.kind: section for section in sections}
    return dataclasses.replace(report, sections=tuple(new.get(old.kind, old) for old in report.sections))


def test_every_section_shows_its_content(report: Report) -> None:
    html = render_html(report)
    assert re.findall(r'<section id="([a-z-]+)"', html) == [
        "results", "tasks", "caveats", "warnings", "reward-quality", "tasks-against-goals", "goals", "ranking",
        "frames", "views", "pixels", "scores-over-time", "sub-goals", "episodes", "learning-curves", "details",
    ]  # fmt: skip
    for text in (
        "Microwave", "The reward ranks episodes.", "62.3\u00a0%", "55.1 to 69.0", "66.6\u00a0%", "must be worse",
        "three seeds only", "<q>open microwave</q>", "ρ = 0.79", "ρ = 0.83", "(0.71 to 0.90), 12 episodes",
        "the reward is a clock", "rank correlation", "<b>0.71</b>", "0.60 to 0.80", "<b>0.61</b>", "<b>0.43</b>",
        "the best", "step 30", 'width="100%"', "A score ↑", "Pixels →", "step 2: a score", "mean reward",
        "✓ success", "✕ no success", "evaluation only", "&#34;folder&#34;: &#34;runs/a&#34;",
    ):  # fmt: skip
        assert text in html, text
    assert html.count('class="point"') == 12 + 3
    assert html.count('src="data:video/mp4;base64,') == 2
    assert html.count('src="data:image/png;base64,') == html.count("alt=") == 3 + 2


def test_a_matrix_has_a_row_per_task_and_the_highest_of_each_goal_in_bold(report: Report) -> None:
    (table,) = re.findall(r"<table>(?:(?!</table>).)*by the goal of.*?</table>", render_html(report), re.DOTALL)
    assert re.findall(r'<th scope="col" class="num">(.*?)</th>', table) == ["delta", "raw", "text"]
    rows = re.findall(r'<tr><th scope="row">(.*?)</th>(.*?)</tr>', table, re.DOTALL)
    cell = r'data-label="(.*?)">(.*?)\s*<span class="note">(.*?)</span></td>'
    assert [(name, re.findall(cell, cells)) for name, cells in rows] == [
        (
            "door",
            [
                ("delta", "<b>0.61</b>", "0.59 to 0.64"),
                ("raw", "0.20", "0.18 to 0.23"),
                ("text", "<b>0.30</b>", "0.28 to 0.33"),
            ],
        ),
        (
            "knob",
            [
                ("delta", "0.10", "0.08 to 0.13"),
                ("raw", "<b>0.43</b>", "0.41 to 0.46"),
                ("text", "0.09", "0.07 to 0.12"),
            ],
        ),
    ]


def test_sentences_show_their_markdown_and_escape_the_rest() -> None:
    sentences = (
        "See [the *page*](https://example.org/a_b?c=1&d) and [findings](docs/findings.md), `zest a *b* <c>`.",
        '**Three** seeds, 2 * 3 * 4 episodes <b>each</b>; [no](javascript:alert(1)) [quote](https://a.b/"onclick=)',
    )
    html = render_html(Report("T", "S", (CAVEATS(sentences),)))
    first, second = re.findall(r"<li>(.*?)</li>", html)
    assert first == (
        'See <a href="https://example.org/a_b?c=1&amp;d">the <em>page</em></a> and findings, '
        "<code>zest a *b* &lt;c&gt;</code>."
    )
    assert second.startswith("<strong>Three</strong> seeds, 2 * 3 * 4 episodes &lt;b&gt;each&lt;/b&gt;; no")
    assert second.endswith('<a href="https://a.b/&#34;onclick=">quote</a>')
    assert "javascript" not in second


def test_an_interval_narrower_than_its_dot_has_end_caps_and_a_correlation_has_a_scale() -> None:
    row = MethodRow("BC", 90.0, 89.9, 90.1, 90.0, 1.0, 1, 20)
    assert interval_bar(row, results_axis([row])).count('class="ci"') == 3
    assert re.findall(r">([−\d]+)</text>", correlation_gauge(0.5)) == ["−1", "0", "1"]


def test_an_empty_report_has_no_sections() -> None:
    html = render_html(Report("Empty", "Nothing was run."))
    assert "Nothing was run." in html
    assert "<section" not in html
    assert "<nav" not in html


def test_the_column_of_the_papers_figures_appears_only_with_figures(report: Report) -> None:
    rows = tuple(dataclasses.replace(row, paper_value=None) for row in report.items(RESULTS))
    assert 'data-label="Paper"' in render_html(Report("t", "s", (RESULTS(report.items(RESULTS)),)))
    assert 'data-label="Paper"' not in render_html(Report("t", "s", (RESULTS(rows),)))


def test_nothing_outside_the_file_is_referred_to(report: Report) -> None:
    html = render_html(report)
    assert not re.findall(r"https?:|\W//\w|@import|url\(", re.sub(r"base64,[^\"]*", "", html))
    assert all(source.startswith("data:") for source in re.findall(r'src="([^"]*)"', html))
    assert all(link.startswith("#") for link in re.findall(r'href="([^"]*)"', html))
    assert "default-src 'none'; img-src data:; media-src data:;" in html
    assert "unsafe" not in html


def test_a_hostile_string_in_any_text_of_a_report_is_shown_escaped(report: Report) -> None:
    hostile: list[str] = []

    def spoil(value: Any) -> Any:
        if isinstance(value, SectionKind):
            return value
        if isinstance(value, str):
            if value in ("method", "control", "dataset"):
                return value
            hostile.append(f"\"><script>alert('{len(hostile)} {{{{ title }}}}')</script>")
            return hostile[-1]
        if isinstance(value, tuple):
            return tuple(spoil(item) for item in value)
        if isinstance(value, dict):
            return {spoil(key): spoil(item) for key, item in value.items()}
        if dataclasses.is_dataclass(value) and not isinstance(value, type):
            return dataclasses.replace(
                value, **{f.name: spoil(getattr(value, f.name)) for f in dataclasses.fields(value)}
            )
        return value

    html = render_html(spoil(report))
    assert html.count("<script") == 1
    assert len(hostile) > 50
    for text in hostile:
        assert text not in html
        as_json = text.replace('"', '\\"')  # keys and values of details are JSON first
        assert str(escape(text)) in html or str(escape(as_json)) in html, text


def test_figures_that_are_not_finite_are_shown_as_a_dash(report: Report) -> None:
    nan, inf = float("nan"), float("inf")
    scores = np.full(N_STEPS + 1, nan, np.float32)
    scores[3:9] = 0.5
    broken = with_sections(
        report,
        RESULTS((MethodRow("not run", nan, nan, nan, inf, nan, 0, 0, paper_value=nan),)),
        GOALS((dataclasses.replace(report.items(GOALS)[0], spearman=nan),)),
        EPISODES((dataclasses.replace(report.items(EPISODES)[0], scores=scores, value=nan),)),
        RANKING((Scatter("s", np.array([1, 2, inf], np.float32), np.array([1, nan, 2], np.float32), nan, (nan, nan)),)),
        LEARNING_CURVES((Series("BC", "loss", np.zeros(2, np.float32), np.full(2, nan, np.float32)),)),
        DETAILS((("config", {"target": nan, "limits": [inf, np.float32("nan")], "array": np.array([nan])}),)),
        REWARD_QUALITY((QualityTable(("d",), (QualityRow("q", "m", ((nan, nan, inf),)),)),)),
        TASKS_AGAINST_GOALS((ScoreMatrix(("d",), ("d",), *np.full((3, 1, 1), nan, np.float32)),)),
        FRAMES((dataclasses.replace(report.items(FRAMES)[0], scores=np.array([nan, inf], np.float32)),)),
    )
    html = render_html(broken)
    text = re.sub(r"base64,[^\"]*|<style>.*?</style>|<script>.*?</script>", "", html, flags=re.DOTALL)
    assert not re.findall(r"(?i)\b(nan|inf|infinity)\b|−inf|nan%", text)
    assert '<b>–</b><span class="note">–</span>' in html
    assert "1 episode, 2 without a finite return not shown" in html
    values = [json.loads(data) for data in re.findall(r'data-values="([^"]*)"', html)]
    assert values[0] == [0.5 if 3 <= step < 9 else None for step in range(N_STEPS + 1)]


@given(st.floats(-1e4, 1e4), st.floats(1e-6, 1e4), st.integers(2, 8), st.sampled_from([0.0, 0.02, 0.05]))
def test_an_axis_has_at_least_two_ticks_and_all_lie_on_it(low: float, size: float, n: int, margin: float) -> None:
    axis = axis_over([low, low + size], n, margin)
    assert 2 <= len(axis.ticks) <= 2.5 * n + 2
    slack = 1e-6 * (axis.high - axis.low)
    assert all(axis.low - slack <= tick <= axis.high + slack for tick in axis.ticks)
    assert len({axis.label(tick) for tick in axis.ticks}) == len(axis.ticks)


def test_the_page_depends_on_the_report_alone(report: Report) -> None:
    assert render_html(report) == render_html(report)


def test_goal_images_are_embedded_as_thumbnails() -> None:
    wide = GoalPanel("wide", (np.zeros((800, 1600, 3), np.uint8),), ("open",))
    encoded = re.findall(r'src="data:image/png;base64,([^"]*)"', render_html(Report("t", "s", (GOALS((wide,)),))))
    assert imageio.imread(base64.b64decode(encoded[0])).shape == (80, 160, 3)


def test_a_video_that_browsers_cannot_play_is_refused(report: Report, tmp_path: Path) -> None:
    def with_video(path: Path) -> Report:
        return with_sections(report, EPISODES((dataclasses.replace(report.items(EPISODES)[0], video=path),)))

    with pytest.raises(BadInput, match=r"mpeg4\.mp4 must be an MP4 file with H\.264 video"):
        render_html(with_video(write_video(tmp_path / "mpeg4.mp4", codec="mpeg4")))
    with pytest.raises(BadInput, match=r"cannot read the video .*absent\.mp4: No such file"):
        render_html(with_video(tmp_path / "absent.mp4"))


def test_parts_that_do_not_fit_together_are_refused(report: Report) -> None:
    episode = report.items(EPISODES)[0]
    three, four = np.zeros(3, np.float32), np.zeros(4, np.float32)
    with pytest.raises(
        BadInput, match="an episode: scores and gt_progress must be equally long, got scores 3, gt_prog"
    ):
        dataclasses.replace(episode, scores=three)
    with pytest.raises(BadInput, match="fps must be positive and finite, got 0"):
        dataclasses.replace(episode, fps=0)
    with pytest.raises(BadInput, match="at least 2 frames, got 1"):
        dataclasses.replace(episode, gt_progress=three[:1], scores=None)
    with pytest.raises(BadInput, match="got x 3, y 4"):
        Scatter("s", three, four, 0.0)
    with pytest.raises(BadInput, match=r"2 sources and 1 goals must have shape \(2, 1\), got \(1, 2\)"):
        ScoreMatrix(("door", "knob"), ("delta",), *np.zeros((3, 1, 2), np.float32))
    with pytest.raises(BadInput, match="got steps 3, values 3, low 4, high 4"):
        Series("BC", "loss", three, three, (four, four))
    with pytest.raises(BadInput, match=r"unknown kind 'metod'; did you mean 'method'"):
        MethodRow("BC", 1, 0, 2, 1, 0, 1, 1, kind="metod")  # type: ignore[arg-type]
    with pytest.raises(BadInput, match=r"shape \(H, W, 3\) and dtype uint8, got shape \(4, 4\) and dtype float64"):
        GoalPanel("g", (np.zeros((4, 4)),), ("open",))


class Browser:
    """A headless Chromium, spoken to over its DevTools pipe (JSON messages that end in a zero byte)."""

    def __init__(self, profile: Path) -> None:
        commands_out, self._commands = os.pipe()
        self._replies, replies_in = os.pipe()
        self._process = subprocess.Popen(
            [
                "bash", "-c", f'exec "$0" "$@" 3<&{commands_out} 4>&{replies_in}', CHROMIUM, "--headless=new",
                "--no-sandbox", "--disable-gpu", "--disable-quic", "--no-first-run", "--disable-background-networking",
                "--disable-component-update", "--disable-sync", "--remote-debugging-pipe", f"--user-data-dir={profile}",
            ],
            pass_fds=(commands_out, replies_in), stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL,
        )  # fmt: skip
        os.close(commands_out)
        os.close(replies_in)
        self._ids = itertools.count(1)
        self._buffer = b""
        self._session: dict[str, str] = {}
        self.events: list[dict[str, Any]] = []
        target = self.call("Target.createTarget", url="about:blank")["targetId"]
        self._session = {"sessionId": self.call("Target.attachToTarget", targetId=target, flatten=True)["sessionId"]}
        for domain in ("Runtime", "Log", "Network", "Page"):
            self.call(f"{domain}.enable")

    def _read(self) -> dict[str, Any]:
        while b"\0" not in self._buffer:
            data = os.read(self._replies, 1 << 16)
            assert data, "the browser went away"
            self._buffer += data
        message, self._buffer = self._buffer.split(b"\0", 1)
        return dict(json.loads(message))

    def call(self, method: str, **params: object) -> dict[str, Any]:
        number = next(self._ids)
        message = {"id": number, "method": method, "params": params, **self._session}
        os.write(self._commands, json.dumps(message).encode() + b"\0")
        while (reply := self._read()).get("id") != number:
            self.events.append(reply)
        assert "error" not in reply, reply
        return dict(reply["result"])

    def evaluate(self, expression: str) -> Any:
        reply = self.call("Runtime.evaluate", expression=expression, awaitPromise=True, returnByValue=True)
        assert "exceptionDetails" not in reply, reply["exceptionDetails"]
        return reply["result"].get("value")

    def open(self, path: Path) -> None:
        self.call("Page.navigate", url=path.as_uri())
        while not any(event["method"] == "Page.loadEventFired" for event in self.events):
            self.events.append(self._read())

    def resize(self, width: int) -> None:
        self.call("Emulation.setDeviceMetricsOverride", width=width, height=900, deviceScaleFactor=1, mobile=False)

    def press(self, key: str) -> None:
        self.call("Input.dispatchKeyEvent", type="keyDown", key=key)
        self.call("Input.dispatchKeyEvent", type="keyUp", key=key)

    def close(self) -> None:
        self._process.terminate()
        self._process.wait(20)
        os.close(self._commands)
        os.close(self._replies)


@pytest.fixture
def browser(tmp_path: Path, report: Report) -> Iterator[Browser]:
    if not CHROMIUM:
        pytest.skip("no chromium on PATH; install it to test the report in a browser (apt-get install chromium)")
    browser = Browser(tmp_path / "profile")
    try:
        browser.resize(1200)
        # A smooth scroll that still goes on would move what a mouse event is aimed at.
        browser.call("Emulation.setEmulatedMedia", features=[{"name": "prefers-reduced-motion", "value": "reduce"}])
        browser.open(write_report(report, tmp_path / "out" / "report.html"))
        yield browser
    finally:
        browser.close()


SEEK = """new Promise((resolve) => {
  const video = document.querySelector("video");
  video.addEventListener("seeked", () => setTimeout(resolve, 0), { once: true });
  video.currentTime = %s;
})"""
WAIT_UNTIL = "new Promise((done) => { const look = () => (%s) ? done() : setTimeout(look, 20); look(); })"
DRAWN = "new Promise((done) => requestAnimationFrame(() => requestAnimationFrame(done)))"
SHOWN_GREY = """(() => {
  const context = Object.assign(document.createElement("canvas"), { width: 64, height: 64 }).getContext("2d");
  context.drawImage(document.querySelector("video"), 0, 0);
  return context.getImageData(32, 32, 1, 1).data[1];
})()"""
STEP = 'Number(document.querySelector(".scrubber").getAttribute("aria-valuenow"))'
CURSOR = '[...document.querySelector(".scrubber").querySelectorAll(".cursor")].map((line) => line.getAttribute("x1"))'


def test_in_a_browser_video_and_chart_follow_each_other(browser: Browser) -> None:
    browser.evaluate(WAIT_UNTIL % "document.querySelector('video').readyState === 4")
    assert browser.evaluate('document.querySelector("video").videoWidth') == 64
    assert browser.evaluate(STEP) == 30, "how the episode ended is what is seen first"
    browser.evaluate(WAIT_UNTIL % "!document.querySelector('video').seeking")
    assert browser.evaluate(SHOWN_GREY) == pytest.approx(GREY + GREY_PER_STEP * 30, abs=GREY_PER_STEP / 2)

    browser.evaluate(SEEK % "1.25")
    assert browser.evaluate(STEP) == 12
    assert browser.evaluate(CURSOR) == ["40%", "40%"]
    spoken = browser.evaluate('document.querySelector(".scrubber").getAttribute("aria-valuetext")')
    assert re.fullmatch(r"step 12 of 30, ZeST score 0\.\d{3}, Ground-truth progress 0\.400", spoken)

    browser.evaluate('document.querySelector(".scrubber").focus()')
    keys = {"ArrowRight": 13, "PageUp": 23, "End": 30, "PageDown": 20, "ArrowLeft": 19, "Home": 0}
    for key, step in keys.items():
        browser.press(key)
        assert browser.evaluate(STEP) == step
        browser.evaluate(WAIT_UNTIL % "!document.querySelector('video').seeking")
        assert browser.evaluate(SHOWN_GREY) == pytest.approx(GREY + GREY_PER_STEP * step, abs=GREY_PER_STEP / 2)

    box = browser.evaluate(
        '(() => { const hit = document.querySelector(".scrubber .hit");'
        'hit.scrollIntoView({ block: "center", behavior: "instant" });'
        "const { left, top, width, height } = hit.getBoundingClientRect(); return [left, top, width, height]; })()"
    )
    browser.evaluate(DRAWN)  # a mouse event finds what is drawn, which a busy machine may not have scrolled yet
    left, top, width, height = box
    for kind, share, step in (("mousePressed", 0.5, 15), ("mouseMoved", 0.8, 24), ("mouseReleased", 0.8, 24)):
        x, y = left + share * width, top + height / 2
        browser.call("Input.dispatchMouseEvent", type=kind, x=x, y=y, button="left", buttons=1, clickCount=1)
        assert browser.evaluate(STEP) == step

    browser.evaluate('document.querySelector(".transport button").click()')
    browser.evaluate(WAIT_UNTIL % "document.querySelector('video').ended")
    browser.evaluate(WAIT_UNTIL % f"{STEP} !== 24")
    assert browser.evaluate(STEP) == 30


def test_in_a_browser_the_page_loads_without_errors_and_asks_for_nothing_else(browser: Browser) -> None:
    assert browser.evaluate("document.querySelectorAll('.point').length") == 15
    assert browser.evaluate("document.querySelector('path.line.score').getTotalLength()") > 100
    assert browser.evaluate("[...document.images].every((image) => image.naturalWidth === 160)")
    requests = [e["params"]["request"]["url"] for e in browser.events if e["method"] == "Network.requestWillBeSent"]
    assert [url.rpartition("/")[2] for url in requests if not url.startswith("data:")] == ["report.html"]
    noise = ("Runtime.exceptionThrown", "Runtime.consoleAPICalled", "Log.entryAdded")
    assert [event for event in browser.events if event["method"] in noise] == []


def test_in_a_browser_the_policy_blocks_what_a_page_might_load(browser: Browser) -> None:
    directive = browser.evaluate(
        "new Promise((done) => {"
        "  document.addEventListener('securitypolicyviolation', (event) => done(event.effectiveDirective));"
        "  new Image().src = 'file:///image.png'; })"
    )
    assert directive == "img-src"


def test_in_a_browser_the_page_fits_its_width_and_the_readers_colour_scheme(browser: Browser) -> None:
    layouts = {}
    for width in (400, 1200):
        browser.resize(width)
        assert browser.evaluate("document.documentElement.scrollWidth") <= width
        layouts[width] = browser.evaluate("getComputedStyle(document.querySelector('tbody tr')).display")
    assert layouts == {400: "flex", 1200: "table-row"}

    colour = "getComputedStyle(document.body).backgroundColor"
    light = browser.evaluate(colour)
    browser.call("Emulation.setEmulatedMedia", features=[{"name": "prefers-color-scheme", "value": "dark"}])
    assert browser.evaluate(colour) != light
