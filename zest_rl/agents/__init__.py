"""Algorithms: one file each, in the same order (config, model, batch, loss, act); the registry is a dict."""
