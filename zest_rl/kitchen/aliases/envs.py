"""``zest_rl.envs``: what the env_spec of every kitchen dataset calls `zest_rl.kitchen.env`."""

from zest_rl.kitchen.env import ENV_ID, HORIZON, KitchenEnv

__all__ = ["ENV_ID", "HORIZON", "KitchenEnv"]
