from __future__ import annotations

import io
import json
from collections.abc import Iterator

import pytest

from zest_rl.analysis import installation
from zest_rl.cli import doctor, main
from zest_rl.cli.terminal import StreamUi
from zest_rl.cli.ui import SilentUi


def test_doctor_finds_this_installation_fit(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["doctor", "--json"]) == 0
    result = json.loads(capsys.readouterr().out)
    checks = {check["name"]: check for check in result["checks"]}
    assert set(checks) >= {
        "python", "packages", "cache", "datasets", "rendering", "weights", "cpu", "gpu", "ffmpeg",
    }  # fmt: skip
    assert all(check["status"] != "fail" for check in checks.values())
    assert checks["rendering"]["detail"].endswith(("egl", "osmesa", "glfw", "native"))
    assert result["next"].startswith("zest collect")


def test_a_check_that_breaks_is_a_failure_with_a_way_to_fix_it(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def broken() -> Iterator[installation.Check]:
        raise OSError("libEGL.so.1 cannot be loaded")
        yield

    monkeypatch.setattr(installation, "CHECKS", {"python": installation.check_python, "rendering": broken})
    result = doctor.run(doctor.Config(), SilentUi())
    assert not result["ok"]
    assert "libegl1" in result["checks"][1]["fix"]
    assert main(["doctor"]) == 1
    out = capsys.readouterr().out
    assert "fail  rendering    OSError: libEGL.so.1 cannot be loaded" in out
    assert "→ install the GL libraries" in out
    assert "1 ok, 0 to look at, 1 failed" in out


def test_a_check_is_shown_before_the_next_one_is_made(monkeypatch: pytest.MonkeyPatch) -> None:
    shown = io.StringIO()

    def second() -> list[installation.Check]:
        return [installation.Check("second", "ok", f"after: {shown.getvalue().split()[:2]}")]

    monkeypatch.setattr(installation, "CHECKS", {"python": installation.check_python, "second": second})
    result = doctor.run(doctor.Config(), StreamUi(results=shown))
    assert result["checks"][1]["detail"] == "after: ['ok', 'python']"
    assert doctor.summary(result) == "2 ok, 0 to look at, 0 failed"
