"""The completion scripts are tried in the shells themselves."""

from __future__ import annotations

import shutil
import subprocess
from pathlib import Path

import pytest

from zest_rl import cli
from zest_rl.cli.completion import completion


@pytest.fixture(scope="module")
def scripts(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("completion")
    for shell in ("bash", "zsh", "fish"):
        (folder / shell).write_text(completion(shell), encoding="utf-8")
    return folder


@pytest.mark.parametrize(
    ("typed", "completed"),
    [
        ("re", "relabel reproduce report"),
        ("train d", "dt"),
        ("train dt --amp ", "auto fp32 bf16"),
        ("train dt --n-u", "--n-updates"),
        ("follow video film.mp4 --goa", "--goals"),
        ("collect --task micro --recipe m", "micro mixed"),
        ("reproduce table1_q", "table1_quick"),
        ("relabel my", "my/door-v0"),
        ("adopt a.onnx --dataset my", "my/door-v0"),
        ("relabel my/door-v0 --preview ", "datasets"),
        ("relabel my/door-v0 --frames left d", "datasets"),
        ("--completion z", "zsh"),
    ],
)
def test_bash_completes_verbs_flags_values_recipes_and_datasets(
    typed: str, completed: str, scripts: Path, tmp_path: Path
) -> None:
    dataset = tmp_path / "datasets" / "my" / "door-v0" / "data"
    dataset.mkdir(parents=True)
    (dataset / "metadata.json").touch()
    code = 'source "$1"; shift; COMP_WORDS=("$@"); COMP_CWORD=$(($# - 1)); _shtab_zest; echo "${COMPREPLY[*]}"'
    words = ["zest", *typed.split(" ")]
    done = subprocess.run(
        ["bash", "-c", code, "bash", str(scripts / "bash"), *words],
        env={"PATH": "/usr/bin:/bin", "MINARI_DATASETS_PATH": str(tmp_path / "datasets")},
        cwd=tmp_path, capture_output=True, text=True, check=True,
    )  # fmt: skip
    assert (done.stdout.split(), done.stderr) == (completed.split(), "")


@pytest.mark.parametrize("shell", ["bash", "zsh", "fish"])
def test_each_shell_reads_its_script(shell: str, scripts: Path) -> None:
    if shutil.which(shell) is None:
        pytest.skip(f"{shell} is not installed")
    done = subprocess.run([shell, "-n", str(scripts / shell)], capture_output=True, text=True)
    assert (done.returncode, done.stderr) == (0, "")


@pytest.mark.skipif(shutil.which("fish") is None, reason="fish is not installed")
def test_fish_says_what_it_completes(scripts: Path) -> None:
    code = f"source {scripts / 'fish'}; complete -C 'zest train dt --n-u'"
    done = subprocess.run(["fish", "--no-config", "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout == "--n-updates\tGradient steps.\n"


def test_an_unknown_shell_is_refused(capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["--completion", "fsh"]) == 2
    assert "--completion is for a shell, got 'fsh'; did you mean 'fish'" in capsys.readouterr().err
