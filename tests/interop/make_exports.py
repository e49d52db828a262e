"""Makes what the consumers' tests read, by the main environment's `zest` command: ``python make_exports.py FOLDER``.

FOLDER/minari holds a relabeled dataset of six noisy kitchen episodes, collected once; FOLDER/exports that dataset in
every format, written anew each time; FOLDER/dataset_id its id.
"""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

import h5py

from zest_rl.data.reader import MANIFEST_FILE

ZEST = Path(sys.executable).with_name("zest")
FORMATS = ("npz", "d4rl", "robomimic", "d3rlpy", "torchrl", "lerobot", "lerobot-progress")
CUT = 63
"""Steps of the shortened episode."""


def zest(*words: str | Path) -> dict[str, Any]:
    """Run a verb and return its JSON document."""
    done = subprocess.run([ZEST, *map(str, words), "--json"], stdout=subprocess.PIPE, check=True)
    document: dict[str, Any] = json.loads(done.stdout)
    return document


def make_ends_differ(dataset: Path) -> None:
    """Let the second episode end by itself and the third one earlier: all the kitchen's meet the same horizon."""
    with h5py.File(dataset / "data/main_data.hdf5", "r+") as file:
        file["episode_1/terminations"][-1], file["episode_1/truncations"][-1] = True, False
        shortened = file["episode_2"]
        horizon = len(shortened["rewards"])
        arrays: list[str] = []
        shortened.visititems(lambda name, node: arrays.append(name) if isinstance(node, h5py.Dataset) else None)
        for name in arrays:
            values = shortened[name][()]
            del shortened[name]
            shortened[name] = values[: len(values) - horizon + CUT]
        shortened["truncations"][-1] = True
        shortened.attrs["total_steps"] = CUT
    path = dataset / "data/metadata.json"
    metadata = json.loads(path.read_text())
    metadata["total_steps"] -= horizon - CUT
    path.write_text(json.dumps(metadata))
    (dataset / MANIFEST_FILE).unlink()


def main(folder: Path) -> None:
    """Collect, relabel and change the ends, unless that was done; export."""
    os.environ |= {"MINARI_DATASETS_PATH": str(folder / "minari"), "ZEST_CACHE": str(folder / "cache")}
    name = folder / "dataset_id"
    if not name.exists():
        shutil.rmtree(folder / "minari", ignore_errors=True)
        made = zest("collect", "--n-episodes", "6", "--noise-max", "0.5", "--dataset", "zest/interop-{task}-v0")
        scored = zest("relabel", made["dataset"], "--views", "1", "--tolerance", "0.05")["dataset"]
        make_ends_differ(folder / "minari" / scored)
        name.write_text(scored)
    shutil.rmtree(folder / "exports", ignore_errors=True)
    for to in FORMATS:
        zest("export", name.read_text(), "--to", to, "--output", folder / "exports" / to)


if __name__ == "__main__":
    main(Path(sys.argv[1]).resolve())
