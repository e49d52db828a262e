"""Commands in processes of their own, and whatever these have started."""

from __future__ import annotations

import os
import secrets
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

ZEST = (sys.executable, "-c", "import sys; from zest_rl.cli import main; sys.exit(main())")
MARK = "TEST_MARK"


class Command:
    """A command, and the processes that inherited a mark from it, wherever they went since."""

    def __init__(self, *words: str, **environ: str) -> None:
        """Start it in a session of its own, in this environment and `environ`."""
        self._mark = secrets.token_hex(8)
        pipes: dict[str, Any] = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "text": True}
        environment = {**os.environ, **environ, MARK: self._mark}
        self.process = subprocess.Popen(words, env=environment, start_new_session=True, **pipes)

    def alive(self) -> list[str]:
        """Command lines of the processes that are there, zombies left out."""
        lines = []
        for folder in Path("/proc").glob("[0-9]*"):
            try:
                if f"{MARK}={self._mark}\0" in (folder / "environ").read_text(errors="replace"):
                    lines.append((folder / "cmdline").read_text(errors="replace").replace("\0", " "))
            except OSError:  # it has ended, or is not ours
                continue
        return [line for line in lines if line]

    def wait_until(self, condition: Callable[[], Any]) -> None:
        """Return when the condition holds, which must be before the command ends."""
        while not condition():
            assert self.process.poll() is None, self.process.communicate()
            time.sleep(0.02)

    def all_end(self) -> bool:
        """Whether no process is left."""
        deadline = time.monotonic() + 60
        while self.alive() and time.monotonic() < deadline:
            time.sleep(0.05)
        return not self.alive()
