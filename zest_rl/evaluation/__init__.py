"""Policy + environment (+ scorer) → episode results."""
