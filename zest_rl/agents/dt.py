"""Decision Transformer: a causal transformer over (return-to-go, observation, action), conditioned on a return.

Chen et al. 2021 (https://arxiv.org/abs/2106.01345; ``gym/`` of https://github.com/kzl/decision-transformer at 5605e40).
The network computes what `transformers.DecisionTransformerModel` does, to the bit, and a run's ``model.safetensors``
loads into that class unchanged. The hyper-parameters are theirs (hidden size 128, 3 layers, 1 head, K = 20, ReLU,
dropout 0.1, batch 64, gradient clip 0.25, weight decay 1e-4). Deviations:
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

import math
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


INITIAL_STD = 0.02


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


class Conv1D(nn.Module):
    """A linear layer whose weight is (n_inputs, n_outputs), as GPT-2 keeps it."""

    def __init__(self, n_inputs: int, n_outputs: int):
        super().__init__()
        self.weight = nn.Parameter(torch.empty(n_inputs, n_outputs))
        self.bias = nn.Parameter(torch.zeros(n_outputs))
        nn.init.normal_(self.weight, std=INITIAL_STD)

    def forward(self, x: Tensor) -> Tensor:
        """[batch, tokens, n_inputs] → [batch, tokens, n_outputs]."""
        return torch.addmm(self.bias, x.view(-1, x.shape[-1]), self.weight).view(*x.shape[:-1], -1)


class Attention(nn.Module):
    """Softmax attention of tokens to those that a mask lets them see."""

    def __init__(self, width: int, n_heads: int, dropout: float):
        super().__init__()
        self.n_heads, self.dropout = n_heads, dropout
        self.c_attn, self.c_proj = Conv1D(width, 3 * width), Conv1D(width, width)
        self.resid_dropout = CheapDropout(dropout)

    def forward(self, tokens: Tensor, mask: Tensor) -> Tensor:
        """[batch, tokens, width] → the same; the mask, added to the weights, is 0 or hugely negative."""
        n, length, width = tokens.shape
        parts = self.c_attn(tokens).split(width, dim=2)
        query, key, value = (part.view(n, length, self.n_heads, -1).transpose(1, 2) for part in parts)
        weights = torch.matmul(query, key.transpose(-1, -2)) * (width // self.n_heads) ** -0.5 + mask
        weights = nn.functional.dropout(weights.softmax(dim=-1).type(value.dtype), self.dropout, self.training)
        seen = torch.matmul(weights, value).transpose(1, 2).reshape(n, length, width)
        mixed: Tensor = self.resid_dropout(self.c_proj(seen))
        return mixed


class FeedForward(nn.Module):
    """Two layers, ReLU between them."""

    def __init__(self, width: int, dropout: float):
        super().__init__()
        self.c_fc, self.c_proj = Conv1D(width, 4 * width), Conv1D(4 * width, width)
        self.dropout = CheapDropout(dropout)

    def forward(self, tokens: Tensor) -> Tensor:
        """[batch, tokens, width] → the same."""
        changed: Tensor = self.dropout(self.c_proj(self.c_fc(tokens).relu()))
        return changed


class Block(nn.Module):
    """Attention and feed-forward layers, each added to what it was given."""

    def __init__(self, width: int, n_heads: int, dropout: float):
        super().__init__()
        self.ln_1, self.attn = nn.LayerNorm(width), Attention(width, n_heads, dropout)
        self.ln_2, self.mlp = nn.LayerNorm(width), FeedForward(width, dropout)

    def forward(self, tokens: Tensor, mask: Tensor) -> Tensor:
        """[batch, tokens, width] → the same."""
        tokens = self.attn(self.ln_1(tokens), mask) + tokens
        return tokens + self.mlp(self.ln_2(tokens))  # type: ignore[no-any-return]


class Encoder(nn.Module):
    """GPT-2 without positions: tokens are told apart by their embeddings; all have that of position 0."""

    def __init__(self, config: DTConfig):
        super().__init__()
        width = config.hidden_size
        self.wte, self.wpe = nn.Embedding(1, width), nn.Embedding(3 * config.context_len, width)
        self.drop = CheapDropout(config.dropout)
        blocks = [Block(width, config.n_heads, config.dropout) for _ in range(config.n_layers)]
        self.h = nn.ModuleList(blocks)
        self.ln_f = nn.LayerNorm(width)
        _initialize(self)
        for block in blocks:
            for added in (block.attn.c_proj, block.mlp.c_proj):
                nn.init.normal_(added.weight, std=INITIAL_STD / math.sqrt(2 * config.n_layers))

    def forward(self, tokens: Tensor, mask: Tensor) -> Tensor:
        """[batch, tokens, width] → the same."""
        tokens = self.drop(tokens + self.wpe(torch.zeros(tokens.shape[:2], dtype=torch.long, device=tokens.device)))
        for block in self.h:
            tokens = block(tokens, mask)
        return self.ln_f(tokens)  # type: ignore[no-any-return]


class DecisionTransformer(nn.Module):
    """`transformers.DecisionTransformerModel`, equal to the bit, from its initial weights to its gradients.

    Not that class itself, since to import transformers takes longer than to evaluate some episodes. Parts that are not
    used (token table, observation and return heads) are kept, frozen, so that weights load there.
    """

    def __init__(self, config: DTConfig, facts: DataFacts):
        super().__init__()
        width = config.hidden_size
        self.encoder = Encoder(config)
        n_timesteps = facts.max_steps if config.timesteps == "absolute" else config.context_len
        self.embed_timestep = nn.Embedding(n_timesteps, width)
        self.embed_return = nn.Linear(1, width)
        self.embed_state = nn.Linear(facts.obs_dim, width)
        self.embed_action = nn.Linear(facts.act_dim, width)
        self.embed_ln = nn.LayerNorm(width)
        self.predict_state = nn.Linear(width, facts.obs_dim)
        self.predict_action = nn.Sequential(nn.Linear(width, facts.act_dim), nn.Tanh())
        self.predict_return = nn.Linear(width, 1)
        for part in self.children():
            if part is not self.encoder:
                _initialize(part)
        for unused in (self.encoder.wte, self.predict_state, self.predict_return):
            unused.requires_grad_(False)

    def forward(self, batch: Batch) -> Tensor:
        """Return the actions [batch, K, act_dim] at each step; without ``valid`` in the batch, nothing is padding."""
        n, length = batch["timesteps"].shape
        obs, action, rtg = (
            self.embed_state(batch["obs"]), self.embed_action(batch["actions"]), self.embed_return(batch["rtg"])
        )  # fmt: skip
        time = self.embed_timestep(batch["timesteps"])
        obs, action, rtg = obs + time, action + time, rtg + time
        tokens = torch.stack((rtg, obs, action), dim=1).permute(0, 2, 1, 3).reshape(n, 3 * length, -1)
        tokens = self.embed_ln(tokens)
        hidden = torch.ones(3 * length, 3 * length, dtype=torch.bool, device=tokens.device).triu(1)
        if "valid" in batch:
            hidden = hidden | ~batch["valid"].repeat_interleave(3, dim=1)[:, None, None]
        mask = torch.zeros(hidden.shape, device=tokens.device).masked_fill_(hidden, torch.finfo(tokens.dtype).min)
        of_obs = self.encoder(tokens, mask).view(n, length, 3, -1)[:, :, 1]
        predicted: Tensor = self.predict_action(of_obs).float()
        return predicted


def _initialize(parts: nn.Module) -> None:
    """Draw the weights of embeddings and linear layers as transformers does."""
    for part in parts.modules():
        if isinstance(part, nn.Embedding | nn.Linear):
            nn.init.normal_(part.weight, std=INITIAL_STD)
        if isinstance(part, nn.Linear):
            nn.init.zeros_(part.bias)


def build_model(config: DTConfig, facts: DataFacts) -> nn.Module:
    """Return the network: the ``obs``, ``actions``, ``rtg`` and ``timesteps`` of a window → its actions."""
    return DecisionTransformer(config, facts)


def predict_actions(model: nn.Module, batch: Batch) -> Tensor:
    """Return the actions [batch, K, act_dim] float32 that the model would take at each step of its windows."""
    predicted: Tensor = model(batch)
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
            actions = mean_action(predict_actions, self._model, batch)[:, -1].cpu().numpy()
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
