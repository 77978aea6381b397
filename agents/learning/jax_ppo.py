"""PPO of Stable-Baselines3 with updates compiled by JAX: the same algorithm in less time."""

from __future__ import annotations

import functools
import math
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import torch
from stable_baselines3 import PPO
from stable_baselines3.common.policies import ActorCriticPolicy
from stable_baselines3.common.torch_layers import FlattenExtractor
from stable_baselines3.common.utils import explained_variance
from torch import nn

_LOGGED = ("policy_gradient_loss", "value_loss", "entropy_loss", "clip_fraction", "approx_kl", "loss")
_BETAS = 0.9, 0.999  # Adam's, as Stable-Baselines3 has them
_EPS = 1e-5
_MOMENTS = "exp_avg", "exp_avg_sq"


class JaxPPO(PPO):
    """PPO of Stable-Baselines3 whose `train` is one function compiled by JAX, for plain networks with ReLU.

    Updates are those of `PPO` but for rounding: the same batches in the same order, loss, clipping of gradients and
    Adam. Parameters and the optimizer's memory stay in torch, so collecting, saving and resuming are those of `PPO`.

    Raises:
        ValueError: for any policy but `ActorCriticPolicy` with ReLU networks, one for the actor and one for the critic.
    """

    def _setup_model(self) -> None:
        super()._setup_model()
        policy: Any = self.policy
        plain = type(policy) is ActorCriticPolicy and type(policy.features_extractor) is FlattenExtractor
        if not plain or policy.activation_fn is not nn.ReLU or self.use_sde:
            raise ValueError(f"JaxPPO needs plain ReLU networks in an ActorCriticPolicy, without gSDE; got {policy}")

    def train(self) -> None:
        """Update the policy from the rollout buffer."""
        policy: Any = self.policy
        self._update_learning_rate(policy.optimizer)
        clip = self.clip_range(self._current_progress_remaining)  # type: ignore[operator]
        parameters = {
            "actor": _layers(policy.mlp_extractor.policy_net, policy.action_net),
            "critic": _layers(policy.mlp_extractor.value_net, policy.value_net),
            "log_std": policy.log_std,
        }
        tensors, structure = jax.tree.flatten(parameters)
        state = policy.optimizer.state
        for tensor in tensors:
            if not state[tensor]:  # as the first step of torch's Adam makes it
                state[tensor]["step"] = torch.tensor(0.0)
                for moment in _MOMENTS:
                    state[tensor][moment] = torch.zeros_like(tensor)
        buffer = self.rollout_buffer
        samples = [
            _flat(values)
            for values in (buffer.observations, buffer.actions, buffer.advantages, buffer.returns, buffer.log_probs)
        ]
        orders = [np.random.permutation(len(samples[0])) for _ in range(self.n_epochs)]  # noqa: NPY002  # as the buffer
        batches = np.concatenate([order.reshape(-1, self.batch_size) for order in orders])
        steps = float(state[policy.log_std]["step"]) + np.arange(1, len(batches) + 1)
        corrections = np.stack([1 - _BETAS[0] ** steps, np.sqrt(1 - _BETAS[1] ** steps)], axis=1)
        constants = policy.optimizer.param_groups[0]["lr"], clip, self.ent_coef, self.vf_coef, self.max_grad_norm
        kept = [tensors, *([state[tensor][name] for tensor in tensors] for name in _MOMENTS)]
        before = tuple(jax.tree.unflatten(structure, [tensor.detach().numpy() for tensor in part]) for part in kept)
        after, logged = _update(
            before, samples, batches.astype(np.int32), corrections.astype(np.float32), np.array(constants, np.float32)
        )
        with torch.no_grad():
            for part, values in zip(kept, after, strict=True):
                for tensor, value in zip(part, jax.tree.leaves(values), strict=True):
                    tensor.copy_(torch.from_numpy(np.array(value)))
            for tensor in tensors:
                state[tensor]["step"].fill_(steps[-1])
        self._n_updates += self.n_epochs
        self._log(np.asarray(logged), clip)

    def _log(self, batches: np.ndarray, clip: float) -> None:
        """Record what `PPO` records; the KL divergence of the last epoch, the loss of the last batch."""
        values = dict(zip(_LOGGED, batches.mean(0), strict=True))
        values["approx_kl"] = batches[-(len(batches) // self.n_epochs) :, _LOGGED.index("approx_kl")].mean()
        values["loss"] = batches[-1, _LOGGED.index("loss")]
        buffer, policy = self.rollout_buffer, self.policy
        values["explained_variance"] = explained_variance(buffer.values.flatten(), buffer.returns.flatten())
        values["std"] = np.exp(policy.log_std.detach().numpy()).mean()
        for name, value in values.items():
            self.logger.record(f"train/{name}", float(value))
        self.logger.record("train/n_updates", self._n_updates, exclude="tensorboard")
        self.logger.record("train/clip_range", clip)


@functools.partial(jax.jit, compiler_options={"xla_cpu_multi_thread_eigen": False})
def _update(before: Any, samples: Any, batches: Any, corrections: Any, constants: Any) -> Any:
    """Gradient steps on batches of samples.

    Args:
        before: parameters, and Adam's two moments of them.
        samples: observations, actions, advantages, returns and logarithms of the actions' probabilities.
        batches: rows of each batch (steps, size).
        corrections: of the bias of Adam's moments (steps, 2).
        constants: learning rate, clip range, weights of entropy and value, largest norm of a gradient.

    Returns:
        The same as `before`, and what is logged of each step (steps, 6).
    """
    rate, clip, entropy, weight, most = constants

    def step(kept: Any, inputs: Any) -> Any:
        (parameters, first, second), (rows, correction) = kept, inputs
        batch = [values[rows] for values in samples]
        gradients, logged = jax.grad(_loss, has_aux=True)(parameters, batch, clip, entropy, weight)
        norm = jnp.sqrt(sum(jnp.sum(jnp.square(gradient)) for gradient in jax.tree.leaves(gradients)))
        scale = jnp.minimum(most / (norm + 1e-6), 1.0)
        gradients = jax.tree.map(lambda gradient: gradient * scale, gradients)
        first = jax.tree.map(lambda old, gradient: old + (1 - _BETAS[0]) * (gradient - old), first, gradients)
        second = jax.tree.map(lambda old, new: _BETAS[1] * old + (1 - _BETAS[1]) * new * new, second, gradients)
        parameters = jax.tree.map(
            lambda old, mean, square: old - rate / correction[0] * mean / (jnp.sqrt(square) / correction[1] + _EPS),
            parameters,
            first,
            second,
        )
        return (parameters, first, second), logged

    return jax.lax.scan(step, before, (batches, corrections))


def _loss(parameters: Any, batch: Any, clip: Any, entropy: Any, weight: Any) -> Any:
    """PPO's loss, and what is logged of it (6,), as `stable_baselines3.PPO.train` has them."""
    observations, actions, advantages, returns, before = batch
    log_std = parameters["log_std"]
    normal = (actions - _mlp(parameters["actor"], observations)) / jnp.exp(log_std)
    constant = jnp.sum(log_std) + 0.5 * log_std.size * math.log(2 * math.pi)
    change = -0.5 * jnp.sum(jnp.square(normal), axis=1) - constant - before[:, 0]
    ratio = jnp.exp(change)
    advantages = advantages[:, 0]
    if len(advantages) > 1:
        advantages = (advantages - jnp.mean(advantages)) / (jnp.std(advantages, ddof=1) + 1e-8)
    clipped = jnp.clip(ratio, 1 - clip, 1 + clip)
    policy_loss = -jnp.mean(jnp.minimum(advantages * ratio, advantages * clipped))
    value_loss = jnp.mean(jnp.square(_mlp(parameters["critic"], observations) - returns))
    entropy_loss = -(constant + 0.5 * log_std.size)
    loss = policy_loss + entropy * entropy_loss + weight * value_loss
    outside, divergence = jnp.mean(jnp.abs(ratio - 1) > clip), jnp.mean(ratio - 1 - change)
    return loss, jnp.stack([policy_loss, value_loss, entropy_loss, outside, divergence, loss])


def _mlp(layers: Any, values: Any) -> Any:
    for weight, bias in layers[:-1]:
        values = jax.nn.relu(values @ weight.T + bias)
    weight, bias = layers[-1]
    return values @ weight.T + bias


def _layers(hidden: nn.Sequential, head: nn.Linear) -> list[tuple[torch.Tensor, torch.Tensor]]:
    return [(layer.weight, layer.bias) for layer in (*hidden, head) if isinstance(layer, nn.Linear)]


def _flat(values: np.ndarray) -> np.ndarray:
    """Values (steps, rows, ...) of a rollout as (rows * steps, size), in the order of the buffer's own batches."""
    return values.swapaxes(0, 1).reshape(values.shape[0] * values.shape[1], -1)
