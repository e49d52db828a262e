from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import pytest
import torch

ROOT = Path(__file__).resolve().parents[1]


def benchmark(*words: str) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-m", "benchmarks", *words]
    return subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=900)


@pytest.mark.skipif(torch.cuda.is_available(), reason="there is a GPU")
def test_the_benchmark_of_a_gpu_tells_how_to_try_it_where_there_is_none() -> None:
    refused = benchmark("gpu")
    assert refused.returncode == 2
    assert "finds no CUDA device here" in refused.stderr
    assert "python -m benchmarks gpu --device cpu" in refused.stderr


@pytest.mark.slow
def test_the_benchmark_of_a_gpu_runs_on_the_cpu(tmp_path: Path) -> None:
    done = benchmark("gpu", "--device", "cpu", "--json", "--output", str(tmp_path / "gpu.json"))
    assert done.returncode == 0, done.stderr
    result = json.loads(done.stdout)["gpu"]
    assert result == json.loads((tmp_path / "gpu.json").read_text())
    assert result["dry_run"]
    assert {"rendering", "embedding", "relabeling", "training", "evaluation"} <= set(result)
    assert result["embedding"]["fp32_against_cpu"]["relative_error"] == 0
    assert result["training"]["largest_relative_difference_of_losses"] == 0
