"""The recurrent forward model of tactile prediction: an LSTM reads the past, another dreams the planned future.

After Nazari, Mandil, Hanheide and Ghalamzan Esfahani, Tactile Dynamic Behaviour Prediction Based on Robot Action
(TAROS 2021): the encoder reads [tactile features ; robot state] step by step, and its (h, c) start the decoder, whose
input at each step is [tactile features it predicted last ; planned robot state]. The paper gives no layer sizes: one
layer of 200 is what its authors' later models have, and the linear head is our choice.
"""

from __future__ import annotations

import torch
from torch import Tensor, nn

from tacpipe.models.lstm import lstm


class RecurrentForward(nn.Module):
    """Encoder and decoder LSTM of one layer each and a linear head; always free running, in training too."""

    def __init__(self, latents: int, states: int, hidden: int = 200) -> None:
        """Make a model of random weights; sizes are numbers of features and of recurrent units."""
        super().__init__()
        self.latents, self.states, self.hidden = latents, states, hidden
        self.encoder = nn.LSTM(latents + states, hidden)
        self.decoder = nn.LSTM(latents + states, hidden)
        self.head = nn.Linear(hidden, latents)

    def forward(self, past: Tensor, plan: Tensor) -> Tensor:
        """Return the predicted tactile features, shape (horizon, window, latent).

        ``past`` is (context, window, latent + state), tactile features first; ``plan`` is (horizon, window, state).

        Feeding the head's output z = V h + b back into the gates, U z + W h, is the same as a recurrent weight
        W + U V and a bias U b. So the decoder is an ordinary LSTM over the plan, which one call computes for all
        steps; only its first step differs, because what is fed back there is measured and not predicted.
        """
        from_input, from_state, *biases = self.encoder.parameters()
        _, state = lstm(past, None, (from_input, from_state, biases[0] + biases[1]))
        from_input, from_state, *biases = self.decoder.parameters()
        feedback, from_plan = from_input.tensor_split([self.latents], dim=1)  # (gate, latent), (gate, state)
        measured = past[-1, :, : self.latents] - self.head(state[0])  # (window, latent)
        recurrent = torch.addmm(from_state, feedback, self.head.weight)
        bias = biases[0] + biases[1] + feedback @ self.head.bias
        states, _ = lstm(plan, state, (from_plan, recurrent, bias), (measured, feedback))
        predicted: Tensor = self.head(states)
        return predicted
