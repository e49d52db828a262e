"""Import this before mujoco.

GL's software drivers and Triton (which torch, timm and transformers load) each bring an LLVM; with the GL library
loaded first, loading Triton crashes Python (seen with Mesa 22.3 and Triton 3). mujoco may load GL when it is imported,
and fails there where ``MUJOCO_GL`` is not one of its values or names a library that is missing: a `ZestError` here.
Costs 0.2 s where Triton is installed.
"""

import importlib
import importlib.util
import os

from zest_rl.errors import ZestError

if importlib.util.find_spec("triton"):
    importlib.import_module("triton")
try:
    importlib.import_module("mujoco")
except (AttributeError, ImportError, OSError, RuntimeError) as error:
    if not os.environ.get("MUJOCO_GL"):
        raise
    raise ZestError(
        f"MuJoCo cannot be loaded with MUJOCO_GL={os.environ['MUJOCO_GL']} ({error}); unset it, so that what works is "
        "chosen, or set it to egl (libegl1), osmesa (software, libosmesa6), glfw (a display) or disable (no pictures)"
    ) from error
