from __future__ import annotations

import importlib.metadata
import json
from collections.abc import Iterator
from pathlib import Path

import pytest

from zest_rl.cli import doctor, main
from zest_rl.cli.ui import SilentUi


def test_doctor_finds_this_installation_fit(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["doctor", "--json"]) == 0
    result = json.loads(capsys.readouterr().out)
    found = {check["name"]: check for check in result["checks"]}
    assert set(found) >= {
        "python", "packages", "cache", "datasets", "rendering", "weights", "cpu", "gpu", "ffmpeg",
    }  # fmt: skip
    assert all(check["status"] != "fail" for check in found.values())
    assert found["rendering"]["detail"].endswith(("egl", "osmesa", "glfw", "native"))
    assert result["next"].startswith("zest collect")


def test_a_package_out_of_range_is_named_with_the_command_that_mends_it(monkeypatch: pytest.MonkeyPatch) -> None:
    real = importlib.metadata.version

    def version(name: str) -> str:
        if name == "timm":
            raise importlib.metadata.PackageNotFoundError(name)
        return "3.12.0" if name == "mujoco" else real(name)

    monkeypatch.setattr(importlib.metadata, "version", version)
    checks = {check.name: check for check in doctor.check_packages()}
    assert checks["package mujoco"].status == "fail"
    assert checks["package mujoco"].detail.startswith("3.12.0, needs ")
    assert "mujoco" in checks["package mujoco"].mend
    assert checks["package timm"].detail == "is not installed"
    assert "packages" not in checks


def test_weights_that_differ_from_the_published_ones_fail(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("zest_rl.runtime.artifacts.hash_file", lambda path: "0" * 64)
    (check,) = doctor.check_weights()
    assert check.status == "fail"
    assert "has sha256 000000000000…, not 579344248a93…" in check.detail
    assert "--force-reinstall" in check.mend


def test_a_gl_backend_that_does_not_work_is_a_failure_with_its_own_words(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("MUJOCO_GL", "no-such-backend")
    (check,) = doctor.check_rendering()
    assert check.status == "fail"
    assert "no-such-backend" in check.detail
    assert "libegl1" in check.mend


def test_a_folder_that_cannot_be_written_to_fails_and_is_not_created(tmp_path: Path) -> None:
    a_file = tmp_path / "file"
    a_file.write_text("")
    check = doctor.check_folder("datasets", a_file, "MINARI_DATASETS_PATH")
    assert check.status == "fail"
    assert "MINARI_DATASETS_PATH" in check.mend
    assert doctor.check_folder("cache", tmp_path / "new" / "folder", "ZEST_CACHE").status in ("ok", "warn")
    assert not (tmp_path / "new").exists()


@pytest.mark.parametrize(("free", "status"), [(2**32, "ok"), (2**30, "warn"), (2**20, "fail")])
def test_little_disk_is_a_warning_and_too_little_a_failure(
    free: int, status: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    real = doctor.shutil.disk_usage(tmp_path)
    monkeypatch.setattr(doctor.shutil, "disk_usage", lambda path: real._replace(free=free))
    check = doctor.check_folder("cache", tmp_path, "ZEST_CACHE")
    assert check.status == status
    assert bool(check.mend) == (status != "ok")


def test_a_check_that_breaks_is_a_failure_with_a_way_to_mend_it(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def broken() -> Iterator[doctor.Check]:
        raise OSError("libEGL.so.1 cannot be loaded")
        yield

    monkeypatch.setattr(doctor, "CHECKS", {"python": doctor.check_python, "rendering": broken})
    result = doctor.run(doctor.Config(), SilentUi())
    assert not result["ok"]
    assert "libegl1" in result["checks"][1]["mend"]
    assert main(["doctor"]) == 1
    out = capsys.readouterr().out
    assert "fail  rendering    OSError: libEGL.so.1 cannot be loaded" in out
    assert "→ install the GL libraries" in out
    assert "1 ok, 0 to look at, 1 failed" in out
