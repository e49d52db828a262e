from __future__ import annotations

import importlib.metadata
from pathlib import Path

import pytest

from zest_rl.analysis import installation


def test_a_package_out_of_range_is_named_with_the_command_that_fixes_it(monkeypatch: pytest.MonkeyPatch) -> None:
    real = importlib.metadata.version

    def version(name: str) -> str:
        if name == "timm":
            raise importlib.metadata.PackageNotFoundError(name)
        return "3.12.0" if name == "mujoco" else real(name)

    monkeypatch.setattr(importlib.metadata, "version", version)
    checks = {check.name: check for check in installation.check_packages()}
    assert checks["package mujoco"].status == "fail"
    assert checks["package mujoco"].detail.startswith("3.12.0, needs ")
    assert "mujoco" in checks["package mujoco"].fix
    assert checks["package timm"].detail == "is not installed"
    assert "packages" not in checks


def test_weights_that_differ_from_the_published_ones_fail(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("zest_rl.runtime.artifacts.hash_file", lambda path: "0" * 64)
    (check,) = installation.check_weights()
    assert check.status == "fail"
    assert "has sha256 000000000000…, not 579344248a93…" in check.detail
    assert "--force-reinstall" in check.fix


def test_a_gl_backend_that_does_not_work_is_a_failure_with_its_own_words(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("MUJOCO_GL", "no-such-backend")
    (check,) = installation.check_rendering()
    assert check.status == "fail"
    assert "no-such-backend" in check.detail
    assert "libegl1" in check.fix


def test_a_folder_that_cannot_be_written_to_fails_and_is_not_created(tmp_path: Path) -> None:
    a_file = tmp_path / "file"
    a_file.write_text("")
    check = installation.check_folder("datasets", a_file, "MINARI_DATASETS_PATH")
    assert check.status == "fail"
    assert "MINARI_DATASETS_PATH" in check.fix
    assert installation.check_folder("cache", tmp_path / "new" / "folder", "ZEST_CACHE").status in ("ok", "warn")
    assert not (tmp_path / "new").exists()


@pytest.mark.parametrize(("free", "status"), [(2**32, "ok"), (2**30, "warn"), (2**20, "fail")])
def test_little_disk_is_a_warning_and_too_little_a_failure(
    free: int, status: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    real = installation.shutil.disk_usage(tmp_path)
    monkeypatch.setattr(installation.shutil, "disk_usage", lambda path: real._replace(free=free))
    check = installation.check_folder("cache", tmp_path, "ZEST_CACHE")
    assert check.status == status
    assert bool(check.fix) == (status != "ok")
