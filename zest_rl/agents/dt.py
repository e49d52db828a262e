"""Decision Transformer: a causal transformer over (return-to-go, observation, action), conditioned on a return.

Chen et al. 2021 (https://arxiv.org/abs/2106.01345; ``gym/`` of https://github.com/kzl/decision-transformer at 5605e40).
The network is `transformers.DecisionTransformerModel`, and a run's ``model.safetensors`` loads into that class
unchanged. The hyper-parameters are theirs (hidden size 128, 3 layers, 1 head, K = 20, ReLU, dropout 0.1, batch 64,
gradient clip 0.25, weight decay 1e-4). Deviations:
  - returns are divided by the largest absolute return of the data, not by 1000;
  - learning rate 3e-4 with 200 updates of warm-up instead of 1e-4 with 10,000, as we train for thousands of updates,
    not for a hundred thousand; what acts is a moving average of the weights, which single updates do not shake;
  - observations are normalised with a floor under the deviation and a bound on the result (`base.STD_FLOOR`);
  - ``train/dt.toml`` and the table use K = 1, which acted best on development data (``docs/findings.md``, 2026-11-26);
  - ``timesteps="relative"`` counts time from the start of the window, so that late steps use trained embeddings;
  - padding repeats a valid step instead of a constant; as in theirs, attention and loss leave it out;
  - transformers initialises every embedding with a standard deviation of 0.02, theirs has torch's default;
  - four elements of a dropout mask share a 64-bit random number, which makes masks cheap on a CPU.
``condition_on_return=False`` is the null control: the return-to-go is zero at every step, in training and acting.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from zest_rl.agents.base import (
    Agent,
    Batch,
    DataFacts,
    Policy,
    ReturnToGo,
    Sampler,
    autocast,
    check_obs,
    check_returns,
    mean_action,
    returns_to_go,
)
from zest_rl.agents.configs import DTConfig as DTConfig
from zest_rl.errors import BadInput
from zest_rl.types import Episode, FloatArray

# ----------------------------------------------------------------------------------------------------------- model


class CheapDropout(nn.Dropout):
    """Dropout whose mask takes 16 random bits per element, so p is rounded to 1/65536.

    ``nn.Dropout`` draws a random number per element, on a CPU a fifth of a training step in bf16.
    """

    def forward(self, x: Tensor) -> Tensor:
        """Return `x`, any shape, with a share p zeroed and the rest divided by 1 − p, as `nn.Dropout` does.

        While training the result is float32, the type of the residual stream that it is added to.
        """
        if not self.training or self.p == 0:
            return x
        bits = torch.empty((x.numel() + 3) // 4, dtype=torch.int64, device=x.device).random_(-(2**63), None)
        keep = bits.view(torch.int16)[: x.numel()].view(x.shape) >= round(self.p * 2**16) - 2**15
        return x * (keep / (1 - self.p))


def build_model(config: DTConfig, facts: DataFacts) -> nn.Module:
    """Return transformers' model, its unused parts (token table, observation and return heads) frozen."""
    from transformers import DecisionTransformerConfig, DecisionTransformerModel  # takes 3 s, for this agent alone

    model = DecisionTransformerModel(
        DecisionTransformerConfig(
            state_dim=facts.obs_dim,
            act_dim=facts.act_dim,
            hidden_size=config.hidden_size,
            max_ep_len=facts.max_steps if config.timesteps == "absolute" else config.context_len,
            n_positions=3 * config.context_len,
            n_layer=config.n_layers,
            n_head=config.n_heads,
            activation_function="relu",
            resid_pdrop=config.dropout,
            embd_pdrop=config.dropout,
            attn_pdrop=config.dropout,
            bos_token_id=None,
            eos_token_id=None,
            use_cache=False,  # else every pass copies the keys and values
            attn_implementation="eager",  # type: ignore[call-arg]  # faster than sdpa on a CPU: 60 tokens, dropout
        )
    )
    for unused in (model.encoder.wte, model.predict_state, model.predict_return):
        unused.requires_grad_(False)
    for module in list(model.modules()):
        for name, child in module.named_children():
            if isinstance(child, nn.Dropout):
                setattr(module, name, CheapDropout(child.p))
    assert isinstance(model, nn.Module)
    return model


def predict_actions(model: nn.Module, batch: Batch) -> Tensor:
    """Return the actions [batch, K, act_dim] float32 that the model would take at each step of its windows."""
    output = model(
        states=batch["obs"],
        actions=batch["actions"],
        returns_to_go=batch["rtg"],
        timesteps=batch["timesteps"],
        attention_mask=batch["valid"].long(),
    )
    predicted: Tensor = output.action_preds.float()
    return predicted


# ----------------------------------------------------------------------------------------------------------- batch


def make_sampler(config: DTConfig, facts: DataFacts, episodes: Sequence[Episode]) -> Sampler:
    """Return a function that draws windows of up to K steps, padded on the left.

    Every step of the data is equally likely to start a window: an episode is drawn in proportion to its length, then a
    start in it. A window ends K steps later or with its episode.

    Raises:
        BadInput: all returns are zero although the model is to be conditioned on them.
    """
    if config.condition_on_return:
        check_returns(facts)
    scale = facts.return_scale if config.condition_on_return else np.inf
    lengths = np.array([len(e) for e in episodes])
    ends = np.repeat(np.cumsum(lengths), lengths)  # [step of the data], the first step after its episode
    obs = torch.from_numpy(facts.normalize(np.concatenate([e.obs[:-1] for e in episodes])))
    actions = torch.from_numpy(np.concatenate([e.actions for e in episodes]))
    rtg = torch.from_numpy(np.concatenate([returns_to_go(e.rewards)[:-1] for e in episodes]) / np.float32(scale))
    since_start = np.concatenate([np.arange(n) for n in lengths])

    def sample(rng: np.random.Generator) -> Batch:
        first = rng.integers(len(ends), size=(config.batch_size, 1))
        steps = np.minimum(first + config.context_len, ends[first]) + np.arange(-config.context_len, 0)
        index = torch.from_numpy(np.maximum(steps, first))
        timesteps = np.maximum(steps - first, 0) + (since_start[first] if config.timesteps == "absolute" else 0)
        return {
            "obs": obs[index],  # [batch, K, obs_dim]
            "actions": actions[index],  # [batch, K, act_dim]
            "rtg": rtg[index][..., None],  # [batch, K, 1]
            "timesteps": torch.from_numpy(timesteps),  # [batch, K]
            "valid": torch.from_numpy(steps >= first),  # [batch, K], False is padding
        }

    return sample


# ------------------------------------------------------------------------------------------------------------ loss


def loss(model: nn.Module, batch: Batch) -> Tensor:
    """Return the squared error of the actions, averaged over the valid steps and the action's dimensions."""
    error = (predict_actions(model, batch) - batch["actions"]).square()  # [batch, K, act_dim]
    return error[batch["valid"]].mean()


# ------------------------------------------------------------------------------------------------------------- act


def acted(model: nn.Module, batch: Batch) -> Tensor:
    """Return what `predict_actions` returns, to the bit, for windows without padding.

    These are the operations of `transformers.DecisionTransformerModel` in their order; without what it checks and
    predicts besides, a step takes half the time.
    """
    parts: Any = model
    n, length = batch["timesteps"].shape
    time = parts.embed_timestep(batch["timesteps"])
    embedded = (parts.embed_return(batch["rtg"]), parts.embed_state(batch["obs"]), parts.embed_action(batch["actions"]))
    tokens = torch.stack([each + time for each in embedded], dim=1).permute(0, 2, 1, 3).reshape(n, 3 * length, -1)
    hidden = parts.embed_ln(tokens) + parts.encoder.wpe.weight[0]  # [batch, 3 K, width]
    later = torch.full((3 * length, 3 * length), torch.finfo(hidden.dtype).min, device=hidden.device).triu(1)
    for block in parts.encoder.h:
        attention = block.attn
        heads = attention.c_attn(block.ln_1(hidden)).view(n, 3 * length, 3, attention.num_heads, attention.head_dim)
        query, key, value = heads.permute(2, 0, 3, 1, 4)
        weights = torch.matmul(query, key.transpose(-1, -2)) * attention.scaling + later
        seen = torch.matmul(weights.softmax(dim=-1).type(value.dtype), value)
        hidden = attention.c_proj(seen.transpose(1, 2).reshape(n, 3 * length, -1)) + hidden
        hidden = hidden + block.mlp(block.ln_2(hidden))
    of_obs = parts.encoder.ln_f(hidden).view(n, length, 3, -1)[:, :, 1]
    predicted: Tensor = parts.predict_action(of_obs).float()
    return predicted


class DTPolicy:
    """Acts by the transformer on the last K steps of N episodes."""

    agent = "dt"

    def __init__(
        self, model: nn.Module, config: DTConfig, facts: DataFacts, meta: dict[str, Any], device: torch.device
    ):
        self.meta = meta
        self.uses_return = config.condition_on_return
        self._model, self._facts, self._device = model, facts, device
        self._autocast = autocast(meta["precision"], device)
        self._config = config
        self._asked = ReturnToGo(facts, self.uses_return)
        self._step = 0
        self._window: deque[dict[str, FloatArray]] = deque(maxlen=config.context_len)

    def begin(self, n_episodes: int, target_return: float | None = None) -> None:
        """Start N new episodes.

        Raises:
            BadInput: the model is conditioned on returns and `target_return` is not a finite number.
        """
        self._asked.begin(n_episodes, target_return)
        self._step = 0
        self._window.clear()

    @torch.no_grad()
    def act(self, obs: FloatArray) -> FloatArray:
        """Return actions (N, act_dim) float32 in [-1, 1] for obs (N, obs_dim) float32, the newest of each episode.

        Raises:
            BadInput: the shape is wrong, or with absolute timesteps the episode is longer than all of the data.
        """
        check_obs(obs, len(self._asked), self._facts.obs_dim)
        bound = self._facts.max_steps
        if self._config.timesteps == "absolute" and self._step >= bound:
            raise BadInput(
                f"this model knows time steps below {bound}, the longest episode of its data, got step {self._step}; "
                f"evaluate with a horizon of at most {bound}, or train with timesteps 'relative'"
            )
        n = len(obs)
        step = {
            "obs": self._facts.normalize(obs),
            "actions": np.zeros((n, self._facts.act_dim), np.float32),  # not known yet; only later steps attend to it
            "rtg": self._asked.scaled()[:, None],
        }
        self._window.append(step)
        length = len(self._window)
        first = 0 if self._config.timesteps == "relative" else self._step + 1 - length
        arrays = {name: np.stack([earlier[name] for earlier in self._window], axis=1) for name in step}
        arrays["timesteps"] = np.broadcast_to(first + np.arange(length), (n, length))
        batch = {name: torch.tensor(array, device=self._device) for name, array in arrays.items()}
        with self._autocast:
            actions = mean_action(acted, self._model, batch)[:, -1].cpu().numpy()
        step["actions"] = actions
        self._step += 1
        return actions.copy()

    def observe(self, rewards: FloatArray) -> None:
        """Subtract the rewards (N,) of the last actions from the returns still asked for."""
        self._asked.subtract(rewards)

    def end(self) -> dict[str, NDArray[Any]]:
        """Return nothing; there are no resources to release."""
        return {}


def make_policy(
    model: nn.Module, config: DTConfig, facts: DataFacts, meta: dict[str, Any], device: torch.device
) -> Policy:
    """Return the policy of a trained model."""
    return DTPolicy(model, config, facts, meta, device)


AGENT = Agent(config=DTConfig, build=build_model, sampler=make_sampler, loss=loss, policy=make_policy)
