"""Ctrl-C, SIGTERM and kills: what the command says, and that nothing that it started is left."""

from __future__ import annotations

import signal
import sys
import time
from collections.abc import Callable
from pathlib import Path

import pytest
from processes import ZEST, Command

from zest_rl.cli.interruption import INTERRUPTED

SAID = f"{INTERRUPTED}\n"
CODES = {signal.SIGINT: 130, signal.SIGTERM: 143}


def doctor(code: str) -> Command:
    """`zest doctor`, whose work is `code`."""
    body = f"def run(config, ui):\n    {code}\ndoctor.run = run; sys.exit(main(['doctor']))"
    command = Command(sys.executable, "-c", f"import sys, time; from zest_rl.cli import doctor, main\n{body}")
    assert command.process.stderr is not None
    assert command.process.stderr.readline() == "ready\n"
    return command


@pytest.mark.parametrize("by", CODES)
def test_an_interruption_ends_with_its_own_code_and_says_how_to_go_on(by: signal.Signals) -> None:
    command = doctor("ui.say('ready'); time.sleep(600)")
    command.process.send_signal(by)
    assert command.process.communicate() == ("", SAID)
    assert command.process.returncode == CODES[by]


@pytest.mark.parametrize("by", CODES)
def test_a_second_signal_ends_a_clean_up_that_hangs(by: signal.Signals) -> None:
    command = doctor(
        "try: ui.say('ready'); time.sleep(600)\n    finally: print('cleaning', file=sys.stderr); time.sleep(600)"
    )
    command.process.send_signal(signal.SIGTERM)
    assert command.process.stderr is not None
    assert command.process.stderr.readline() == "cleaning\n"
    command.process.send_signal(by)
    assert command.process.communicate() == ("", SAID)
    assert command.process.returncode == CODES[by]


def test_a_second_signal_ends_a_command_whose_stderr_is_closed() -> None:
    command = doctor(
        "import os\n"
        "    try: ui.say('ready'); time.sleep(600)\n"
        "    finally: print('cleaning', file=sys.stderr); os.closerange(1, 3); time.sleep(600)"
    )
    command.process.send_signal(signal.SIGTERM)
    assert command.process.stderr is not None
    assert command.process.stderr.read() == "cleaning\n"
    command.process.send_signal(signal.SIGTERM)
    assert command.process.wait() == 143


def test_an_interruption_that_a_library_makes_another_error_of_is_still_one() -> None:
    command = doctor("try: ui.say('ready'); time.sleep(600)\n    except BaseException: raise ImportError('failed')")
    command.process.send_signal(signal.SIGTERM)
    assert command.process.communicate() == ("", SAID)
    assert command.process.returncode == 143


@pytest.mark.parametrize("delay", [0.1, 0.5, 1.0, *(pytest.param(n / 7, marks=pytest.mark.slow) for n in range(20))])
def test_sigterm_during_the_start_is_an_interruption_whatever_is_being_imported(delay: float, tmp_path: Path) -> None:
    places = {"MINARI_DATASETS_PATH": str(tmp_path / "minari"), "ZEST_CACHE": str(tmp_path / "cache")}
    command = Command(*ZEST, "collect", "--task", "micro", "--n-workers", "1", **places)
    time.sleep(delay)
    command.process.send_signal(signal.SIGTERM)
    out, err = command.process.communicate()
    assert out == ""
    assert "zest_rl" not in err, "a traceback of ours; glfw's is of a child that it asks while it is imported"
    assert command.process.returncode in (143, -signal.SIGTERM)  # the latter: Python itself had not started
    assert (SAID in err) == (command.process.returncode == 143)
    assert command.all_end()


# --- nothing is left --------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("by", [signal.SIGTERM, signal.SIGKILL])
def test_policies_in_other_programs_end_with_the_command_and_so_does_what_they_started(
    by: signal.Signals, adopt: Callable[..., Path], server: Callable[[str], str], tmp_path: Path
) -> None:
    adopted = adopt(
        server("""
import subprocess
cut = os.environ.get("TEST_MARK")
if cut:
    subprocess.Popen(["sleep", "601"])
for step, line in enumerate(sys.stdin):
    print(json.dumps({"ready": 1, "actions": [[0] * 9 for _ in json.loads(line).get("obs", ())]}), flush=True)
    if cut and step > 2:
        time.sleep(602)
""")
    )
    command = Command(*ZEST, "evaluate", str(adopted), "--n-episodes", "12", "--n-workers", "2")
    command.wait_until(lambda: sum("sleep 601" in line for line in command.alive()) == 2)
    command.process.send_signal(by)
    _, err = command.process.communicate()
    assert command.process.returncode == (143 if by == signal.SIGTERM else -9)
    assert err.endswith(SAID) == (by == signal.SIGTERM)
    assert "Traceback" not in err
    assert command.all_end(), command.alive()


@pytest.mark.slow
@pytest.mark.parametrize("by", [signal.SIGTERM, signal.SIGKILL])
def test_the_processes_of_torchrun_end_with_it(by: signal.Signals, collected: str, tmp_path: Path) -> None:
    zest = str(Path(sys.executable).with_name("zest"))
    torchrun = [str(Path(sys.executable).with_name("torchrun")), "--standalone", "--nproc-per-node=2", "--no-python"]
    words = ["train", "bc", collected, "--n-updates", "1000000", "--threads", "1", "--device", "cpu"]
    command = Command(*torchrun, zest, *words, "--run-dir", str(tmp_path / "run"))
    command.wait_until((tmp_path / "run" / "metrics.csv").exists)
    command.process.send_signal(by)
    _, err = command.process.communicate()
    assert (SAID in err) == (by == signal.SIGTERM)
    assert command.all_end(), command.alive()


@pytest.mark.slow
def test_the_processes_of_ray_end_with_an_interrupted_command(collected: str) -> None:
    words = ["relabel", collected, "--views", "2", "--tolerance", "0.001", "--engine", "ray", "--n-workers", "2"]
    command = Command(*ZEST, *words)
    command.wait_until(lambda: any("_Worker" in line for line in command.alive()))
    command.process.send_signal(signal.SIGTERM)
    _, err = command.process.communicate()
    assert (command.process.returncode, err.endswith(SAID)) == (143, True)
    assert command.all_end(), command.alive()


# --- nobody reads -----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("words", ["--help", "collect --help", "doctor", "doctor --json", "collect --task no --json"])
@pytest.mark.parametrize("redirection", ["", "2>&1"])
def test_a_pipe_that_nobody_reads_is_no_complaint(words: str, redirection: str) -> None:
    code = "import sys; from zest_rl.cli import doctor, main; doctor.run = lambda *_: {'checks': []}; sys.exit(main())"
    script = f'set -o pipefail; "{sys.executable}" -c "{code}" {words} {redirection} | sleep 0'
    command = Command("bash", "-c", script)
    _, err = command.process.communicate()
    assert [line for line in err.splitlines() if "unknown task 'no'" not in line] == []
    assert command.process.returncode == 141
