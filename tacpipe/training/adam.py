"""Adam (Kingma and Ba, Adam: A Method for Stochastic Optimization, 2015), to the bit as `torch.optim.Adam` computes it.

The first `torch.optim.Adam` of a process imports torch's compiler, which takes as long as torch itself: 1.2 s of processor
time, of some 6 s that a short training of one epoch takes. The function that it calls at each step needs none of that.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping

import torch
from torch import Tensor
from torch.optim.adam import adam

BETAS, EPSILON = (0.9, 0.999), 1e-8  # those of the paper, and torch's defaults


class Adam:
    """Steps along the gradients of weights; ``weight_decay`` of each weight is added to its gradient."""

    def __init__(self, weights: Iterable[Tensor], learning_rate: float, weight_decay: float = 0.0) -> None:
        self.weights = list(weights)
        self.learning_rate, self.weight_decay = learning_rate, weight_decay
        self._state: dict[int, dict[str, Tensor]] = {}

    def zero_grad(self) -> None:
        """Forget all gradients."""
        for weight in self.weights:
            weight.grad = None

    def step(self) -> None:
        """Change each weight that has a gradient; others stay, and so does what is known of them."""
        changed = [(number, weight) for number, weight in enumerate(self.weights) if weight.grad is not None]
        state = [self._moments(number) for number, _ in changed]
        with torch.no_grad():
            adam(
                [weight for _, weight in changed],
                [weight.grad for _, weight in changed if weight.grad is not None],
                [moments["exp_avg"] for moments in state],
                [moments["exp_avg_sq"] for moments in state],
                [],
                [moments["step"] for moments in state],
                fused=True,
                amsgrad=False,
                beta1=BETAS[0],
                beta2=BETAS[1],
                lr=self.learning_rate,
                weight_decay=self.weight_decay,
                eps=EPSILON,
                maximize=False,
            )

    def state(self) -> dict[int, dict[str, Tensor]]:
        """Return what is known of each weight that had a gradient, by its number: ``step``, ``exp_avg``, ``exp_avg_sq``."""
        return self._state

    def load(self, state: Mapping[int, Mapping[str, Tensor]]) -> None:
        """Take over what `state` returned of weights in the same order, maybe on another device."""
        self._state = {
            number: {name: value.to(self.weights[number].device) for name, value in moments.items()}
            for number, moments in state.items()
        }

    def _moments(self, number: int) -> dict[str, Tensor]:
        if number not in self._state:
            weight = self.weights[number]
            self._state[number] = {
                "step": torch.zeros((), dtype=torch.float32, device=weight.device),
                "exp_avg": torch.zeros_like(weight, memory_format=torch.preserve_format),
                "exp_avg_sq": torch.zeros_like(weight, memory_format=torch.preserve_format),
            }
        return self._state[number]
