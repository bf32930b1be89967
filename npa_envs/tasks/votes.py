"""What particles say of their world's class: votes, accuracies, colours."""

from __future__ import annotations

import torch
from torch import Tensor

PALETTE = (
    (0.90, 0.10, 0.29),
    (0.24, 0.71, 0.29),
    (1.00, 0.85, 0.10),
    (0.26, 0.39, 0.85),
    (0.96, 0.51, 0.19),
    (0.57, 0.12, 0.71),
    (0.27, 0.80, 0.85),
    (0.94, 0.20, 0.90),
    (0.50, 0.35, 0.14),
    (0.05, 0.05, 0.05),
)
"""Red, green and blue of class 0, 1, ...; classes beyond begin anew."""

UNDECIDED = (0.6, 0.6, 0.6)
"""Colour of a particle that says nothing."""


def particle_classes(outputs: Tensor) -> Tensor:
    """Return the class that each particle says, int64, shape [B, N].

    Args:
        outputs: One number for each class, shape [B, N, K].
    """
    return outputs.argmax(-1)


def majority(outputs: Tensor) -> Tensor:
    """Return the class that most particles of each world say, int64, shape [B].

    Of several with as many votes it is the one with the larger sum of outputs.

    Args:
        outputs: One number for each class, shape [B, N, K].
    """
    particle_count, class_count = outputs.shape[1:]
    classes = torch.arange(class_count, device=outputs.device)
    votes = (particle_classes(outputs)[..., None] == classes).sum(1)
    sums = outputs.double().sum(1)
    # Less than one vote, whatever the outputs.
    tie_breaker = 0.5 * torch.softmax(sums / particle_count, dim=-1)
    return (votes + tie_breaker).argmax(-1)


def class_colours(outputs: Tensor) -> Tensor:
    """Return each particle's colour, its class's, greyer the less it is sure of it; [B, N, 3].

    Args:
        outputs: One number for each class, shape [B, N, K]; 1 is sure.
    """
    rows = [PALETTE[k % len(PALETTE)] for k in range(outputs.shape[-1])]
    sure, chosen = outputs.max(-1, keepdim=True)
    sure = sure.clamp(0.0, 1.0)
    colours = []
    for channel, grey in enumerate(UNDECIDED):
        # Scalar by scalar: a tensor of the palette would be a copy to the device in each picture.
        colour = torch.zeros_like(sure)
        for number, row in enumerate(rows):
            colour = torch.where(chosen == number, row[channel], colour)
        colours.append(grey + sure * (colour - grey))
    return torch.cat(colours, dim=-1)
