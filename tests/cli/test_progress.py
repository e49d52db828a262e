"""Progress bars and lines, on a terminal and elsewhere."""

from __future__ import annotations

import io

import pytest

from zest_rl.cli.terminal import StreamUi
from zest_rl.cli.ui import SilentUi, Ui
from zest_rl.errors import ZestError


class Terminal(io.StringIO):
    """A stream that says it is a terminal."""

    def isatty(self) -> bool:
        return True


def test_without_a_terminal_progress_is_a_line_every_ten_seconds_and_one_at_the_end() -> None:
    stream, now = io.StringIO(), 0.0
    with StreamUi(stream, clock=lambda: now).progress("collecting", 30) as advance:
        for _ in range(30):
            now += 1.0
            advance(loss=0.123456)
    assert stream.getvalue().splitlines() == [
        "collecting: 10/30 (33%), 10 s, about 20 s left, loss 0.1235",
        "collecting: 20/30 (67%), 20 s, about 10 s left, loss 0.1235",
        "collecting: 30/30 (100%), 30 s, loss 0.1235",
    ]


def test_on_a_terminal_progress_is_a_bar_and_may_be_nested(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("TERM", "xterm")
    stream = Terminal()
    ui = StreamUi(stream)
    with ui.progress("cells", 2) as outer:
        with ui.progress("steps [1]", 5) as inner:
            inner(5, loss=0.5)
            ui.warn("[b] is odd")
        outer(2)
    ui.say("done")
    text = stream.getvalue()
    assert "━" in text
    assert "steps [1]" in text
    assert "2/2" in text
    assert "warning: [b] is odd" in text
    assert text.endswith("done\n")


def test_a_bar_is_taken_down_when_the_work_fails() -> None:
    ui = StreamUi(Terminal())
    with pytest.raises(ZestError), ui.progress("cells", 2):
        raise ZestError("broken")
    with ui.progress("cells", 1) as advance:
        advance()


def test_the_silent_ui_prints_nothing(capsys: pytest.CaptureFixture[str]) -> None:
    ui: Ui = SilentUi()
    ui.say("a")
    ui.warn("b")
    with ui.progress("c", 1) as advance:
        advance(1, loss=2.0)
    assert capsys.readouterr() == ("", "")
