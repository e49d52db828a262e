"""Policies in processes of their own: what a program must answer, and that nothing is left of one that does not."""

from __future__ import annotations

import json
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import pytest
from tiny_dataset import SHORT_HORIZON

from zest_rl.agents.child import PolicyProcess
from zest_rl.errors import ZestError
from zest_rl.evaluation.evaluate import EPISODES_PER_JOB, EvaluationConfig, evaluate, evaluation_folder


def status(process: Path) -> list[str]:
    """What the kernel tells of a process after its name: state, parent, group, …; nothing of one that is gone."""
    try:
        return (process / "stat").read_text().rpartition(")")[2].split()
    except OSError:
        return []


def is_alive(pid: int) -> bool:
    return status(Path(f"/proc/{pid}"))[:1] not in ([], ["Z"])


def group_of(process: Path) -> int | None:
    fields = status(process)
    return int(fields[2]) if fields and fields[0] != "Z" else None


def test_every_part_has_a_process_of_its_own_that_is_told_how_many_episodes_begin_and_ends_after_them(
    adopt: Callable[..., Path], server: Callable[[str], str], tmp_path: Path
) -> None:
    log = tmp_path / "log"
    run = adopt(
        server(f"""
seen = []
for line in sys.stdin:
    message = json.loads(line)
    seen.append(message.get("begin", len(message.get("obs", ()))))
    print(json.dumps({{"ready": 1, "actions": [[0] * 9 for _ in message.get("obs", ())]}}), flush=True)
print(json.dumps(seen), file=open({str(log)!r}, "a"))
""")
    )
    log.unlink()
    evaluate(run, EvaluationConfig(n_episodes=EPISODES_PER_JOB + 1), n_workers=1)
    played = [json.loads(line) for line in log.read_text().splitlines()]
    dims = {"obs_dim": 59, "act_dim": 9}
    assert played == [[{"n_episodes": n, **dims}, *[n] * SHORT_HORIZON] for n in (EPISODES_PER_JOB, 1)]
    assert not is_alive(int((tmp_path / "pid").read_text()))


ANSWER = "print(json.dumps({'ready': 1, 'actions': %s}), flush=True)\n"
LOOP = "for step, line in enumerate(sys.stdin):\n    obs = json.loads(line).get('obs', ())\n    "


@pytest.mark.parametrize(
    ("code", "message"),
    [
        ("sys.exit('no weights here')", "ended with exit code 1 instead of answering; its stderr ends with:\nno w"),
        ("os.kill(os.getpid(), 9)", "ended with exit code -9 instead of answering"),
        ("os.close(1); time.sleep(600)", "closed its stdout instead of answering"),
        ("import subprocess; subprocess.Popen(['sleep', '600']); time.sleep(600)", "gave no answer within 5 s and was"),
        ("print('Loading…', flush=True); sys.stdin.read()", "must answer one line {\"ready\": …} of JSON, got b'Load"),
        ("print('[]', flush=True); sys.stdin.read()", 'must answer one line {"ready": …} of JSON, got b\'[]'),
        (LOOP + "print('{\"ready\": 1}', flush=True)", 'must answer one line {"actions": …} of JSON, got b\'{"re'),
        (LOOP + ANSWER % "[[0] * 8 for _ in obs]", "must give actions of shape (4, 9) for obs (4, 59), got (4, 8)"),
        (LOOP + ANSWER % "[0] * len(obs)", "must give actions of shape (4, 9) for obs (4, 59), got (4,)"),
        (LOOP + ANSWER % "[[0] * i for i in range(len(obs))]", "failed on obs of shape (4, 59) (ValueError:"),
        (LOOP + ANSWER % "[[float('nan')] * 9] + [[0] * 9 for _ in obs[1:]]", "gave NaN or infinity as action of 1 of"),
        (LOOP + ANSWER % "[[1e999] * 9 for _ in obs]", "gave NaN or infinity as action of 4 of 4 episodes (the first"),
    ],
)  # fmt: skip
def test_a_program_that_does_not_act_is_refused_with_a_reason_and_leaves_nothing(
    code: str,
    message: str,
    collected: str,
    server: Callable[[str], str],
    refusal: Callable[..., tuple[int, str]],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setenv("ZEST_POLICY_TIMEOUT", "5" if "sleep'" in code else "60")
    got, said = refusal(
        "adopt", server(code), "--dataset", collected, "--name", "mine", "--run-dir", tmp_path / "r" / "x"
    )
    assert got == 1
    assert "policy 'mine' (command)" in said
    assert message in said
    assert not (tmp_path / "r" / "x").exists()
    pid = int((tmp_path / "pid").read_text())
    assert not is_alive(pid)
    assert not [other for other in Path("/proc").glob("[0-9]*") if group_of(other) == pid], "what it started is there"


def test_a_program_that_dies_in_an_episode_leaves_no_result_and_finished_parts_are_kept(
    adopt: Callable[..., Path], server: Callable[[str], str], tmp_path: Path
) -> None:
    mark = tmp_path / "played"
    code = f"import pathlib\nmark = pathlib.Path({str(mark)!r})\n" + LOOP
    code += f"if step == {SHORT_HORIZON} and mark.exists(): sys.exit('out of memory')\n    "
    run = adopt(server(code + ANSWER % "[[0] * 9 for _ in obs]" + "mark.touch()"))
    mark.unlink()
    config = EvaluationConfig(n_episodes=EPISODES_PER_JOB + 1)
    with pytest.raises(
        ZestError, match=r"ended with exit code 1 instead of answering; its stderr ends with:\nout of mem"
    ):
        evaluate(run, config, n_workers=1)
    folder = evaluation_folder(run.resolve(), config)
    assert len(list((folder / "parts").glob("*.npz"))) == 1
    assert not (folder / "result.json").exists()
    mark.unlink()
    assert len(evaluate(run, config, n_workers=1).episodes) == config.n_episodes


def test_a_hanging_program_is_gone_when_zest_is_killed(
    collected: str, server: Callable[[str], str], tmp_path: Path
) -> None:
    spec = server("time.sleep(600)")
    code = "import sys; from zest_rl.cli import main; sys.exit(main(sys.argv[1:]))"
    words = ["adopt", spec, "--dataset", collected, "--run-dir", str(tmp_path / "x")]
    with subprocess.Popen([sys.executable, "-c", code, *words], stderr=subprocess.DEVNULL) as process:
        while not ((tmp_path / "pid").exists() and (tmp_path / "pid").read_text()):
            assert process.poll() is None, "it ended before it could be killed"
            time.sleep(0.05)
        pid = int((tmp_path / "pid").read_text())
        assert is_alive(pid)
        process.send_signal(signal.SIGKILL)
    end = time.monotonic() + 30
    while is_alive(pid) and time.monotonic() < end:
        time.sleep(0.05)
    assert not is_alive(pid)
    assert not (tmp_path / "x").exists()


def test_a_timeout_that_is_no_number_is_refused(
    collected: str,
    server: Callable[[str], str],
    refusal: Callable[..., tuple[int, str]],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setenv("ZEST_POLICY_TIMEOUT", "long")
    code, message = refusal("adopt", server(""), "--dataset", collected, "--run-dir", tmp_path / "x")
    assert code == 2
    assert "ZEST_POLICY_TIMEOUT must be seconds: could not convert string to float: 'long'" in message


def test_a_program_that_cannot_be_started_leaves_no_open_file() -> None:
    process = PolicyProcess(["sh", "x" * 2**22], 59, 9)  # longer than a command line may be
    before = sorted(Path("/proc/self/fd").iterdir())
    for _ in range(3):
        with pytest.raises(OSError, match="Argument list too long"):
            process.begin(1)
    process.end()
    assert sorted(Path("/proc/self/fd").iterdir()) == before
