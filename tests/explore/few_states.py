"""How the tiny dataset is seen here."""

EMBEDDER = {"embedder": "efficientnet-lite0", "precision": "auto", "device": "auto", "backend": "auto"}
OPTIONS = {"views": 2, "tolerance": 0.05, **EMBEDDER}
"""Few states, seen twice, so that all are embedded within seconds."""
