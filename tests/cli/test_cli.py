from __future__ import annotations

import errno
import json
import os
import resource
import subprocess
import sys
import tomllib
import warnings
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from types import ModuleType
from typing import Annotated, Any, Literal

import pytest
import tyro

from zest_rl import __version__, cli
from zest_rl.cli.config import load_config, parse_config, read_recipe, recipe_path
from zest_rl.cli.ui import Ui
from zest_rl.cli.verbs import VERBS
from zest_rl.errors import BadInput, Notice, ZestError

ROOT = Path(__file__).resolve().parents[2]


@dataclass(frozen=True)
class Config:
    """Make a toy."""

    dataset: Annotated[tyro.conf.Positional[str], tyro.conf.arg(metavar="DATASET")]
    """Id of a dataset."""
    similarity: Literal["cos", "l2"] = "cos"
    """Which similarity."""
    n_episodes: int = 3
    """How many episodes."""
    noise: float = 0.5
    """Standard deviation, in rad."""
    views: tuple[int, ...] = (1, 2)
    size: tuple[int, int] = (224, 224)
    out: Path | None = None
    video: bool = False

    def __post_init__(self) -> None:
        if self.n_episodes < 1:
            raise BadInput(f"n-episodes must be at least 1, got {self.n_episodes}")


Run = Callable[[Any, Ui], dict[str, Any]]


@pytest.fixture
def toy(monkeypatch: pytest.MonkeyPatch) -> Callable[..., ModuleType]:
    """Add a verb `toy` to the command."""

    def add(run: Run, **contents: Any) -> ModuleType:
        module = ModuleType("zest_rl.cli.toy")
        module.__dict__.update({"Config": Config, "run": run} | contents)
        monkeypatch.setitem(sys.modules, "zest_rl.cli.toy", module)
        monkeypatch.setitem(VERBS, "toy", "make a toy")
        return module

    return add


def raises(error: BaseException) -> Run:
    def run(config: Any, ui: Ui) -> dict[str, Any]:
        raise error

    return run


def write(folder: Path, text: str) -> Path:
    path = folder / "toy.toml"
    path.write_text(text)
    return path


# --- the command ------------------------------------------------------------------------------------------------------


def test_a_warning_of_the_library_is_told_like_the_command_s_own(
    toy: Callable[..., ModuleType], capsys: pytest.CaptureFixture[str]
) -> None:
    def run(config: Any, ui: Ui) -> dict[str, Any]:
        for _ in range(2):
            with warnings.catch_warnings():  # forgets what was told
                warnings.warn("a.heic is left out", Notice, stacklevel=1)
        warnings.warn("of another library", UserWarning, stacklevel=1)
        return {"made": 1}

    toy(run)
    with warnings.catch_warnings():  # pytest records them instead
        warnings.showwarning = lambda *parts: print("shown by Python:", parts[0], file=sys.stderr)
        assert cli.main(["toy", "a"]) == 0
    assert capsys.readouterr().err == "warning: a.heic is left out\nshown by Python: of another library\n"


def test_help_answers_at_once_and_names_verbs_and_exit_codes() -> None:
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    done = subprocess.run(
        [sys.executable, "-c", "import sys; from zest_rl.cli import main; sys.exit(main())", "--help"],
        capture_output=True,
        text=True,
        check=True,
    )
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    seconds = used.ru_utime + used.ru_stime - before.ru_utime - before.ru_stime
    assert seconds < 2, "half a second is promised; processor time, for the machine may be busy"
    assert all(f"\n  {verb} " in done.stdout for verb in VERBS)
    assert "exit codes: 0 done, 1 failed, 2 bad input" in done.stdout


@pytest.mark.parametrize("verb", VERBS)
def test_the_help_of_every_verb_imports_nothing_heavy(verb: str) -> None:
    """Except torch for `train`: its sub-verbs are the agents' registry, so that a new agent needs no line here."""
    code = (
        "import sys; from zest_rl.cli import main; code = main([sys.argv[1], '--help']); "
        "heavy = {'torch', 'transformers', 'mujoco', 'minari', 'timm', 'gymnasium'} & set(sys.modules); "
        "sys.exit(code or ' '.join(heavy - set(sys.argv[2:])) or 0)"
    )
    allowed = ["torch"] if verb == "train" else []
    done = subprocess.run([sys.executable, "-c", code, verb, *allowed], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert f"usage: zest {verb}" in done.stdout


@pytest.mark.parametrize("encoding", ["ascii", "latin-1"])
@pytest.mark.parametrize("words", [["--help"], ["relabel", "--help"], ["select"], ["inspect", "zest/цель-v0"]])
def test_help_and_messages_print_in_every_encoding(words: list[str], encoding: str) -> None:
    done = subprocess.run(
        [sys.executable, "-c", "import sys; from zest_rl.cli import main; sys.exit(main())", *words],
        env=os.environ | {"PYTHONIOENCODING": encoding, "LC_ALL": "C", "PYTHONCOERCECLOCALE": "0", "PYTHONUTF8": "0"},
        capture_output=True, encoding=encoding,
    )  # fmt: skip
    assert done.returncode == (0 if "--help" in words else 2), done.stderr
    assert "Unicode" not in done.stderr
    assert done.stdout if "--help" in words else done.stderr.startswith("error: ")


def test_every_verb_describes_itself_and_its_arguments(capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["doctor", "--help"]) == 0
    out = capsys.readouterr().out
    assert "say how to fix" in out
    assert "--recipe FILE.toml" in out


def test_the_version_is_the_package_s(capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["--version"]) == 0
    assert capsys.readouterr().out == f"zest {__version__}\n"


@pytest.mark.parametrize(
    ("argv", "complaint"),
    [
        (["colect"], "error: unknown verb 'colect'; did you mean 'collect'"),
        (["--json", "doctor"], "the verb comes first: zest VERB --json"),
        (["toy"], "DATASET"),
        (["toy", "d", "--n-epsodes", "4"], "--n-episodes"),
        (["toy", "d", "--similarity", "dot"], "--similarity must be one of 'cos', 'l2', got 'dot'"),
        (["toy", "d", "e"], "unexpected 'e'"),
        (["toy", "d", "--noise"], "zest toy: --noise must be a number, got nothing; write it after the flag"),
        (["toy", "d", "--n-episodes", "0"], "error: n-episodes must be at least 1, got 0\n"),
        (["toy", "d", "--recipe"], "zest toy: --recipe needs a file: --recipe FILE.toml"),
    ],
)
def test_bad_input_is_one_error_on_stderr_and_exit_code_2(
    argv: list[str], complaint: str, toy: Callable[..., ModuleType], capsys: pytest.CaptureFixture[str]
) -> None:
    toy(lambda config, ui: {})
    assert cli.main(argv) == 2
    out, err = capsys.readouterr()
    assert err.startswith("error: ")
    assert complaint in err
    assert not set("│╭╰") & set(err)
    assert "Traceback" not in err
    assert out == "" or "--json" in argv


def test_no_verb_at_all_shows_the_help(capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main([]) == 2
    assert "usage: zest VERB" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("error", "code", "message"),
    [
        (ZestError("no GL library"), 1, "error: no GL library"),
        (BadInput("no such task"), 2, "error: no such task"),
        (
            OSError(errno.ENOSPC, "No space left", "/data/x"),
            1,
            "error: the disk is full at /data/x; free some",
        ),
        (PermissionError(errno.EACCES, "Permission denied", "/data/x"), 1, "error: Permission denied at /data/x"),
        (KeyError("x"), 1, "error: unexpected KeyError: 'x'; ZEST_TRACEBACK=1 shows where"),
        (KeyboardInterrupt(), 130, "interrupted; run the same command again to go on"),
    ],
)
def test_each_kind_of_failure_has_its_exit_code_and_no_traceback(
    error: BaseException,
    code: int,
    message: str,
    toy: Callable[..., ModuleType],
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.delenv("ZEST_TRACEBACK", raising=False)
    toy(raises(error))
    assert cli.main(["toy", "d"]) == code
    out, err = capsys.readouterr()
    assert err.startswith(message)
    assert "Traceback" not in err
    assert out == ""


def test_a_traceback_is_shown_when_asked_for(
    toy: Callable[..., ModuleType], capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("ZEST_TRACEBACK", "1")
    toy(raises(ZestError("no GL library")))
    assert cli.main(["toy", "d"]) == 1
    assert "Traceback" in capsys.readouterr().err


def test_with_json_a_failure_is_a_document_too(
    toy: Callable[..., ModuleType], capsys: pytest.CaptureFixture[str]
) -> None:
    toy(raises(ZestError("no GL library")))
    assert cli.main(["toy", "d", "--json"]) == 1
    document = json.loads(capsys.readouterr().out)
    assert document == {"error": {"type": "ZestError", "message": "no GL library", "exit_code": 1}}
    assert cli.main(["toy", "--json", "--n-episodes", "four"]) == 2
    assert json.loads(capsys.readouterr().out)["error"]["type"] == "BadInput"


def test_with_json_stdout_holds_the_result_alone(
    toy: Callable[..., ModuleType], capsys: pytest.CaptureFixture[str]
) -> None:
    def run(config: Config, ui: Ui) -> dict[str, Any]:
        print("a library talks")
        ui.say("writing")
        return {"dataset": config.dataset, "next": "zest train bc d"}

    toy(run)
    assert cli.main(["toy", "d", "--json"]) == 0
    out, err = capsys.readouterr()
    assert json.loads(out) == {"dataset": "d", "next": "zest train bc d"}
    assert err == "a library talks\nwriting\n"


def test_the_summary_lists_the_result_and_ends_with_the_next_command(
    toy: Callable[..., ModuleType], capsys: pytest.CaptureFixture[str]
) -> None:
    result = {
        "ok": True, "mean": 0.123456, "seeds": [1, 2], "returns": {"demo": 10}, "cells": [{"task": "micro"}],
        "next": "zest report",
    }  # fmt: skip
    toy(lambda config, ui: result)
    assert cli.main(["toy", "d"]) == 0
    assert capsys.readouterr().out.splitlines() == [
        "mean: 0.1235", "seeds: 1, 2", "returns:", "  demo: 10", "cells 1:", "  task: micro", "next: zest report",
    ]  # fmt: skip


def test_figures_are_listed_with_one_unit_each(
    toy: Callable[..., ModuleType], capsys: pytest.CaptureFixture[str]
) -> None:
    result = {
        "normalized_return": {"value": 36.57, "low": 30.1, "high": 42.0}, "iqm": 35.0, "clipped_actions": 0.012,
        "success": {"value": 0.0, "low": 0.0, "high": 0.161}, "n_episodes": 20,
    }  # fmt: skip
    toy(lambda config, ui: result)
    assert cli.main(["toy", "d"]) == 0
    assert capsys.readouterr().out.splitlines() == [
        "normalized_return: 36.6 % of the expert, 95 % interval 30.1 to 42.0 %", "iqm: 35.0 %",
        "clipped_actions: 1.2 %", "success: 0 of 20, 95 % interval 0 to 16 %", "n_episodes: 20",
    ]  # fmt: skip
    toy(lambda config, ui: {"return": {"value": -12.345, "low": -14.0, "high": -1.0}, "iqm": -12.0})
    assert cli.main(["toy", "d"]) == 0
    assert capsys.readouterr().out.splitlines() == ["return: -12.35, 95 % interval -14 to -1", "iqm: -12"]


def test_a_verb_may_write_its_own_summary(toy: Callable[..., ModuleType], capsys: pytest.CaptureFixture[str]) -> None:
    toy(lambda config, ui: {"n": 3}, summary=lambda result: f"{result['n']} toys")
    assert cli.main(["toy", "d"]) == 0
    assert capsys.readouterr().out == "3 toys\n"


def test_a_result_that_is_not_ok_exits_with_1(toy: Callable[..., ModuleType]) -> None:
    toy(lambda config, ui: {"ok": False})
    assert cli.main(["toy", "d"]) == 1


def test_a_verb_with_sub_verbs_gives_run_the_config_of_the_chosen_one(
    toy: Callable[..., ModuleType], capsys: pytest.CaptureFixture[str]
) -> None:
    toy(lambda config, ui: {"got": type(config).__name__}, Config=None, CONFIGS={"one": Config})
    assert cli.main(["toy", "one", "d", "--json"]) == 0
    assert json.loads(capsys.readouterr().out) == {"got": "Config"}
    assert cli.main(["toy", "--help"]) == 0
    assert "  one        Make a toy." in capsys.readouterr().out
    assert cli.main(["toy", "onn"]) == 2
    assert "needs a sub-verb first, got 'onn'; did you mean 'one'?" in capsys.readouterr().err
    assert cli.main(["toy"]) == 2
    assert "needs a sub-verb first, got nothing; valid: one" in capsys.readouterr().err


# --- recipes ----------------------------------------------------------------------------------------------------------


def test_a_recipe_supplies_defaults_and_flags_win(tmp_path: Path) -> None:
    recipe = write(tmp_path, 'verb = "toy"\ndataset = "d"\nn-episodes = 7\nnoise = 1\nviews = [4, 5]\nout = "o"\n')
    config, as_json = parse_config(Config, ["--recipe", str(recipe), "--noise", "0.25"], "toy")
    assert config == Config("d", n_episodes=7, noise=0.25, views=(4, 5), out=Path("o"))
    assert not as_json
    config, as_json = parse_config(Config, ["e", f"--recipe={recipe}", "--n_episodes", "8", "--json", "--video"], "toy")
    assert (config.dataset, config.n_episodes, config.noise, config.video) == ("e", 8, 1.0, True)
    assert as_json


def test_flags_mean_what_the_help_says() -> None:
    words = [
        "--noise=-0.5",
        "--out",
        "None",
        "--views",
        "4",
        "--no-video",
        "--size",
        "1",
        "2",
        "--n-episodes",
        "8",
        "d",
    ]
    config, _ = parse_config(Config, words, "toy")
    assert config == Config("d", n_episodes=8, noise=-0.5, views=(4,), size=(1, 2))
    config, _ = parse_config(Config, ["d", "--noise", "-2", "--views", "--video"], "toy")
    assert config == Config("d", noise=-2.0, views=(), video=True)


def test_a_list_before_a_required_positional_leaves_the_last_word_to_it(tmp_path: Path) -> None:
    for words in (["--views", "4", "5", "d"], ["--views", "4", "5", "d", "--json"], ["d", "--views", "4", "5"]):
        assert parse_config(Config, words, "toy")[0] == Config("d", views=(4, 5))
    recipe = write(tmp_path, 'dataset = "d"')
    config, _ = parse_config(Config, ["--recipe", str(recipe), "--views", "4", "5"], "toy")
    assert config == Config("d", views=(4, 5)), "nothing is missing, so the list keeps all"
    with pytest.raises(BadInput, match="DATASET is required: --views took '4 5'; write DATASET before the flags"):
        parse_config(Config, ["--views", "4", "5", "--noise", "1"], "toy")


def test_negative_numbers_are_values_and_all_after_two_hyphens_is_positional() -> None:
    assert parse_config(Config, ["d", "--noise", "-1e-4"], "toy")[0].noise == -1e-4
    assert parse_config(Config, ["--views", "4", "--", "-d_s"], "toy")[0] == Config("-d_s", views=(4,))
    with pytest.raises(BadInput) as caught:
        parse_config(Config, ["d", "--", "--noise", "3"], "toy")
    assert str(caught.value) == "zest toy: unexpected '--noise'\n  unexpected '3'"


def test_all_problems_of_a_command_line_are_reported_at_once() -> None:
    with pytest.raises(BadInput) as caught:
        parse_config(Config, ["--n-episodes", "x", "--size", "1", "b", "--nose=3", "--similarity=dot"], "toy")
    assert str(caught.value).splitlines() == [
        "zest toy: unknown flag '--nose'; did you mean '--noise' or '--size' or '--out'? valid: --n-episodes, "
        "--noise, --out, --similarity, --size, --video, --views",
        "  --n-episodes must be an integer, got 'x'",
        "  --size must be a list [an integer, an integer], got '1 b'",
        "  --similarity must be one of 'cos', 'l2', got 'dot'",
        "  DATASET is required",
    ]
    with pytest.raises(BadInput) as caught:
        parse_config(Config, ["d", "--video=1", "--json=1", "--noise", "--size", "1"], "toy")
    assert str(caught.value).splitlines() == [
        "zest toy: --video takes no value, got '1'; write --video alone",
        "  --json takes no value, got '1'; write --json alone",
        "  --noise must be a number, got nothing; write it after the flag",
        "  --size must be a list [an integer, an integer], got '1'",
    ]


def test_help_shows_the_recipe_s_values_as_the_defaults(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    recipe = write(tmp_path, "n_episodes = 77")
    with pytest.raises(SystemExit) as stop:
        parse_config(Config, ["--recipe", str(recipe), "--help"], "toy")
    assert stop.value.code == 0
    assert "(default: 77)" in capsys.readouterr().out


def test_all_problems_of_a_recipe_are_reported_at_once(tmp_path: Path) -> None:
    recipe = write(
        tmp_path,
        'n_episods = 3\nsimilarity = "dot"\nnoise = "much"\n'
        'views = [1, "two"]\nsize = [1]\nvideo = 1\nn-episodes = true',
    )
    with pytest.raises(BadInput) as caught:
        parse_config(Config, ["d", "--recipe", str(recipe)], "toy")
    for problem in (
        "unknown key 'n_episods'; did you mean 'n-episodes'?",
        "'similarity' must be one of 'cos', 'l2', got 'dot'",
        "'noise' must be a number, got 'much'",
        "'views' must be a list of an integer, got [1, 'two']",
        "'size' must be a list [an integer, an integer], got [1]",
        "'video' must be true or false, got 1",
        "'n-episodes' must be an integer, got True",
    ):
        assert problem in str(caught.value)


def test_a_key_given_in_both_spellings_is_refused() -> None:
    with pytest.raises(BadInput, match="given twice"):
        load_config(Config, {"dataset": "d", "n-episodes": 1, "n_episodes": 2}, "table 1")


def test_a_recipe_for_another_verb_is_refused(tmp_path: Path) -> None:
    recipe = write(tmp_path, 'verb = "train dt"')
    with pytest.raises(BadInput, match="is for `zest train dt`, not for `zest train bc`"):
        parse_config(Config, ["--recipe", str(recipe)], "train bc")


def test_a_recipe_that_is_missing_or_no_toml_is_refused(tmp_path: Path) -> None:
    write(tmp_path, "n_episodes = = 3")
    with pytest.raises(BadInput, match=r"there is no recipe .*tiy\.toml; did you mean 'toy\.toml'"):
        read_recipe(tmp_path / "tiy.toml")
    with pytest.raises(BadInput, match=r"toy\.toml is not TOML: .*line 1"):
        read_recipe(tmp_path / "toy.toml")


@pytest.mark.parametrize(
    ("name", "verb", "path"),
    [
        ("demo", "reproduce", "eval/demo.toml"),
        ("table1_quick", "reproduce", "eval/table1_quick.toml"),
        ("micro", "collect", "datasets/micro.toml"),
        ("dt", "train dt", "train/dt.toml"),
        ("multistep", "follow kitchen", "eval/multistep.toml"),
    ],
)
def test_a_recipe_that_comes_with_the_package_goes_by_its_name_in_any_folder(
    name: str, verb: str, path: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / name).mkdir()
    found = recipe_path(Path(name), verb)
    assert found == Path(path)
    assert read_recipe(found) == tomllib.loads((ROOT / path).read_text(encoding="utf-8"))
    (tmp_path / name).rmdir()
    (tmp_path / name).write_text("", encoding="utf-8")
    assert recipe_path(Path(name), verb) == Path(name), "a file of one's own comes first"


def test_a_wrong_name_of_a_recipe_lists_the_nearest_ones(refusal: Callable[..., tuple[int, str]]) -> None:
    code, message = refusal("reproduce", "dmeo")
    assert (code, "there is no recipe dmeo in eval; did you mean 'demo'" in message) == (2, True)
    code, message = refusal("collect", "--recipe", "mixd")
    assert (code, "there is no recipe mixd in datasets; did you mean 'mixed'" in message) == (2, True)


def test_a_recipe_by_its_name_gives_the_arguments_of_a_verb(capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["collect", "--recipe", "micro", "--help"]) == 0
    assert "0.5391" in capsys.readouterr().out


def test_a_config_can_be_built_from_a_table_alone() -> None:
    table = {"dataset": "d", "n-episodes": 2, "size": [64, 32]}
    assert load_config(Config, table, "cell micro") == Config("d", n_episodes=2, size=(64, 32))
    with pytest.raises(BadInput, match=r"^cell micro: unknown key 'nois'(.|\n)*'dataset' is required$"):
        load_config(Config, {"nois": 1.0}, "cell micro")
    with pytest.raises(BadInput, match="cell micro: n-episodes must be at least 1"):
        load_config(Config, {"dataset": "d", "n_episodes": 0}, "cell micro")
