from __future__ import annotations

import os
import subprocess
import sys


def test_a_gl_setting_that_mujoco_refuses_is_told_with_the_possible_ones() -> None:
    code = "import sys, zest_rl.cli; sys.exit(zest_rl.cli.main(['evaluate', '.']))"
    command = [sys.executable, "-c", code]
    refused = subprocess.run(command, env=os.environ | {"MUJOCO_GL": "garbage"}, capture_output=True, text=True)
    assert refused.returncode == 1
    assert refused.stderr.startswith("error: MuJoCo cannot be loaded with MUJOCO_GL=garbage (")
    for possible in ("egl", "osmesa", "glfw", "disable"):
        assert possible in refused.stderr
