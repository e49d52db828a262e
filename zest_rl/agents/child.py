"""A policy in a separate process, in another Python or another language: lines of JSON over its pipes.

The process answers each line on stdin with one line on stdout; ``docs/foreign_policies.md`` has an example::

    {"begin": {"n_episodes": N, "obs_dim": 59, "act_dim": 9}}    →  {"ready": true}
    {"obs": [[59 numbers], … N rows]}                            →  {"actions": [[9 numbers], … N rows]}
    end of stdin                                                 →  it exits

One process plays one batch of N episodes in lockstep, from first observation to last: one ``begin``, then one ``obs``
per step. Numbers are written with enough digits to be read back as the same float32.
"""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
import tempfile
import threading
from collections.abc import Sequence
from contextlib import suppress
from typing import IO, Any

from zest_rl.errors import BadInput, ZestError
from zest_rl.runtime.parallel import THREAD_VARIABLES
from zest_rl.types import FloatArray

TIMEOUT_VARIABLE, TIMEOUT = "ZEST_POLICY_TIMEOUT", 120.0
"""Seconds that one answer may take; the first one includes the start of the process and its imports."""
GRACE = 5.0
"""Seconds that the process has after the end of stdin before it is killed."""
MAX_ANSWER = 2**24  # bytes; a longer line is cut and fails to parse
# A process between us and the command, which with whatever it starts is in a group of its own. The guard kills that
# group when the command ends, and when our end of a pipe is closed, so also when we are killed: a hanging command would
# not notice that its stdin has ended.
_GUARD = """
import os, signal, subprocess, sys, threading
command = subprocess.Popen(sys.argv[2:], process_group=0)
def kill():
    try:
        os.killpg(command.pid, signal.SIGKILL)
    except ProcessLookupError:
        pass
def watch():
    os.read(int(sys.argv[1]), 1)
    kill()
threading.Thread(target=watch, daemon=True).start()
os.close(0)
os.close(1)
os.waitid(os.P_PID, command.pid, os.WEXITED | os.WNOWAIT)  # not reaped yet: the group's number is still its own
kill()
code = command.wait()
if code < 0:
    os.kill(os.getpid(), -code)
os._exit(abs(code))
"""


class PolicyProcess:
    """A command that acts; `begin` starts its process and `end` ends it."""

    def __init__(self, words: Sequence[str], obs_dim: int, act_dim: int):
        """Check the command; `begin` runs it.

        Raises:
            BadInput: there is no such program, or `TIMEOUT_VARIABLE` is not a number.
        """
        if shutil.which(words[0]) is None:
            raise BadInput(f"there is no program {words[0]!r}; give its path, or fix PATH")
        try:
            self._timeout = float(os.environ.get(TIMEOUT_VARIABLE, TIMEOUT))
        except ValueError as error:
            raise BadInput(f"{TIMEOUT_VARIABLE} must be seconds: {error}") from error
        self._words, self._dims = list(words), {"obs_dim": obs_dim, "act_dim": act_dim}
        self._process: subprocess.Popen[bytes] | None = None
        self._errors: IO[bytes] | None = None
        self._held: int | None = None

    def begin(self, n_episodes: int) -> None:
        """Start the process and tell it how many episodes it plays.

        Raises:
            ZestError: the answer is late, missing or malformed.
        """
        self.end()
        self._errors = tempfile.TemporaryFile()  # noqa: SIM115  (`end` closes it)
        watched, self._held = os.pipe()
        try:
            self._process = subprocess.Popen(
                [sys.executable, "-I", "-S", "-c", _GUARD, str(watched), *self._words],
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                stderr=self._errors,
                env={**os.environ, **dict.fromkeys(THREAD_VARIABLES, "1")},  # results must not depend on the load
                start_new_session=True,  # Ctrl-C is for us; we end it
                pass_fds=[watched],
            )
        finally:
            os.close(watched)
        self._ask({"begin": {"n_episodes": n_episodes, **self._dims}}, "ready")

    def __call__(self, obs: FloatArray) -> Any:
        """Return the process's answer to obs (N, obs_dim): actions, not checked here.

        Raises:
            ZestError: the answer is late, missing or malformed.
        """
        return self._ask({"obs": obs.tolist()}, "actions")

    def end(self) -> None:
        """Close the process's stdin and wait for it to exit; kill it if it does not."""
        process, self._process = self._process, None
        if process is not None and process.stdin is not None and process.stdout is not None:
            with suppress(OSError):  # the process may be gone before it read the last line
                process.stdin.close()
            with suppress(subprocess.TimeoutExpired):
                process.wait(GRACE)
            self._kill()
            process.wait()
            process.stdout.close()
        self._kill()  # where no process could be started
        if self._errors is not None:
            self._errors.close()

    def _kill(self) -> None:
        """Let the guard kill the command and whatever it started."""
        held, self._held = self._held, None
        if held is not None:
            os.close(held)

    def _ask(self, message: dict[str, Any], key: str) -> Any:
        process = self._process
        assert process is not None
        assert process.stdin is not None
        assert process.stdout is not None
        timed_out = threading.Event()

        def give_up() -> None:
            timed_out.set()
            self._kill()  # ends the wait for its pipes below

        timer = threading.Timer(self._timeout, give_up)
        timer.start()
        try:
            process.stdin.write(json.dumps(message).encode() + b"\n")
            process.stdin.flush()
            line = process.stdout.readline(MAX_ANSWER)
        except BrokenPipeError:
            line = b""
        finally:
            timer.cancel()
        if timed_out.is_set():
            raise ZestError(
                f"the policy's process gave no answer within {self._timeout:g} s and was killed; it must answer "
                "each line of stdin by one line on stdout, and flush it. If it only needs longer, set "
                f"{TIMEOUT_VARIABLE} (seconds){self._stderr_tail()}"
            )
        if not line:
            with suppress(subprocess.TimeoutExpired):
                process.wait(GRACE)
            code = process.poll()
            outcome = "closed its stdout" if code is None else f"ended with exit code {code}"
            raise ZestError(f"the policy's process {outcome} instead of answering{self._stderr_tail()}")
        try:
            return json.loads(line)[key]
        except (ValueError, TypeError, KeyError):
            raise ZestError(
                f'the policy\'s process must answer one line {{"{key}": …}} of JSON, got {line[:80]!r}; let it print '
                f"everything else to stderr{self._stderr_tail()}"
            ) from None

    def _stderr_tail(self) -> str:
        """Return the last lines of the process's stderr, for a message."""
        assert self._errors is not None
        size = self._errors.seek(0, os.SEEK_END)
        self._errors.seek(max(0, size - 1000))
        text = self._errors.read().decode(errors="replace").strip()
        return f"; its stderr ends with:\n{text}" if text else ""
