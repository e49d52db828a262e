"""Goal + embedder → scores → a relabeled dataset."""
