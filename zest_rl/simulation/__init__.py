"""MuJoCo models: state → frames, fast and deterministic."""
