"""Datasets, episodes and videos → figures about them."""
