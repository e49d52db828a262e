"""Acts for zest_rl with a model that d3rlpy saved, in the Python that has d3rlpy: ``serve_d3rlpy.py MODEL.d3``.

`zest_rl.agents.child` starts it and describes what passes. It needs d3rlpy alone, of any Python that d3rlpy runs on.
"""

from __future__ import annotations

import json
import os
import sys


def main() -> None:
    """Answer on the stdout that there was at the start; whatever else is printed goes to stderr."""
    answers = os.fdopen(os.dup(1), "w")
    os.dup2(2, 1)
    del sys.path[0]  # the folder of this file, whose names d3rlpy's imports must not meet
    import d3rlpy
    import numpy as np

    model = d3rlpy.load_learnable(sys.argv[1], device="cpu:0")
    if not isinstance(model, d3rlpy.algos.QLearningAlgoBase):
        sys.exit(f"{type(model).__name__} acts on returns, which are not handed out; serve it by a program of your own")
    for line in sys.stdin:
        message = json.loads(line)
        if "begin" in message:
            answer = {"ready": True}
        else:
            obs = np.array(message["obs"], dtype=np.float32)
            answer = {"actions": model.predict(obs).tolist()}
        print(json.dumps(answer), file=answers, flush=True)


if __name__ == "__main__":
    main()
