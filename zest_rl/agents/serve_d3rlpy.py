"""Serves a model that d3rlpy saved, in a Python that has d3rlpy: ``serve_d3rlpy.py MODEL.d3``.

`zest_rl.agents.child` starts it and describes the protocol. It imports d3rlpy alone, not zest_rl.
"""

from __future__ import annotations

import json
import os
import sys


def main() -> None:
    """Answer on the original stdout; everything else that is printed goes to stderr."""
    answers = os.fdopen(os.dup(1), "w")
    os.dup2(2, 1)
    del sys.path[0]  # the folder of this file, whose modules must not shadow those that d3rlpy imports
    import d3rlpy
    import numpy as np

    model = d3rlpy.load_learnable(sys.argv[1], device="cpu:0")
    if not isinstance(model, d3rlpy.algos.QLearningAlgoBase):
        sys.exit(
            f"{type(model).__name__} acts on returns, which this protocol does not send; serve it by your own program"
        )
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
