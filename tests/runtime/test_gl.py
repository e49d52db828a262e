from __future__ import annotations

import os
import subprocess
import sys
import threading
from concurrent.futures import ThreadPoolExecutor

from zest_rl.runtime.gl import cached_in_thread


def test_a_gl_setting_that_mujoco_refuses_is_told_with_the_possible_ones() -> None:
    code = "import sys, zest_rl.cli; sys.exit(zest_rl.cli.main(['evaluate', '.']))"
    command = [sys.executable, "-c", code]
    refused = subprocess.run(command, env=os.environ | {"MUJOCO_GL": "garbage"}, capture_output=True, text=True)
    assert refused.returncode == 1
    assert refused.stderr.startswith("error: MuJoCo cannot be loaded with MUJOCO_GL=garbage (")
    for possible in ("egl", "osmesa", "glfw", "disable"):
        assert possible in refused.stderr


def test_each_thread_draws_with_what_it_opened_itself_and_opens_it_once() -> None:
    opened = list[str]()

    @cached_in_thread
    def open_canvas(name: str) -> int:
        opened.append(name)
        return threading.get_ident()

    with ThreadPoolExecutor(1) as other:
        there = [other.submit(open_canvas, "kitchen").result() for _ in range(2)]
        here = [open_canvas("kitchen") for _ in range(2)]
    assert opened == ["kitchen", "kitchen"]
    assert there[0] == there[1] != here[0] == here[1]
