"""Import this before mujoco.

GL's software drivers and Triton (which torch, timm and transformers load) each bring an LLVM; with the GL library
loaded first, loading Triton crashes Python (seen with Mesa 22.3 and Triton 3). mujoco may load GL when it is imported.
Costs 0.2 s where Triton is installed.
"""

import importlib
import importlib.util

if importlib.util.find_spec("triton"):
    importlib.import_module("triton")
