"""A local page that scores a dataset by any pictures as soon as they are dropped on it: `zest explore`."""
