"""What changes from iteration to iteration: which views, before what, and how sharp."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from npa_envs.world.cuda_graph import sent


class ViewSchedule:
    """Views, backgrounds and blur of an iteration, on the device.

    All follow from the seed and the iteration alone, so a resumed run goes on as it would have; the
    tensors stay the same ones, so a recorded graph reads what was written last.

    Args:
        view_count: Views to choose from.
        chosen_count: Views of an iteration, all different; at most `view_count`.
        seed: What views and backgrounds are drawn from.
        blur_sigma: Standard deviation of the blur at first [pixels].
        blur_iterations: Iterations after which there is none; it goes evenly.
        device: Where the tensors are.
    """

    def __init__(
        self,
        view_count: int,
        chosen_count: int,
        *,
        seed: int,
        blur_sigma: float,
        blur_iterations: int,
        device: str | torch.device,
    ) -> None:
        self._view_count = view_count
        self._seed = seed
        self._blur_sigma = blur_sigma
        self._blur_iterations = blur_iterations
        chosen_count = min(chosen_count, view_count)
        self.index = torch.zeros(chosen_count, dtype=torch.int64, device=device)
        """Which views, shape [V]."""
        self.backgrounds = torch.zeros(chosen_count, 3, device=device)
        """Red, green and blue behind them, in [0, 1], shape [V, 3]."""
        self.sigma = torch.zeros((), device=device)
        """Standard deviation of their blur [pixels], shape []."""
        self.begin(0)

    def begin(self, iteration: int) -> None:
        """Write what an iteration sees; the host does not wait for the device.

        Args:
            iteration: Iterations done so far in the run.
        """
        random = np.random.default_rng((self._seed, iteration))
        index = random.choice(self._view_count, len(self.index), replace=False)
        backgrounds = random.random(self.backgrounds.shape, dtype=np.float32)
        left = max(0.0, 1.0 - iteration / self._blur_iterations)
        sigma = np.array(self._blur_sigma * left, dtype=np.float32)
        device = self.sigma.device
        self.index.copy_(sent(index.astype(np.int64), device))
        self.backgrounds.copy_(sent(backgrounds, device))
        self.sigma.copy_(sent(sigma, device))


def blurred(pictures: Tensor, sigma: Tensor) -> Tensor:
    """Return pictures blurred by a Gaussian; beyond their edges they are 0.

    Two products with a matrix of weights: the standard deviation may change without the host
    knowing it, and one of 0 leaves the pictures as they are, bit for bit.

    Args:
        pictures: Shape [V, H, W, K]; colours times alpha, and alpha.
        sigma: Standard deviation [pixels], shape [].
    """
    rows, columns = (_weights(size, sigma, pictures) for size in pictures.shape[1:3])
    across = torch.einsum("xw,vhwk->vhxk", columns, pictures)
    return torch.einsum("yh,vhxk->vyxk", rows, across)


def _weights(size: int, sigma: Tensor, like: Tensor) -> Tensor:
    """Return the matrix of a blur along one side, [size, size]."""
    far = torch.arange(-size, size + 1, device=like.device, dtype=like.dtype)
    place = far[size : 2 * size]
    variance = sigma.to(like).square().clamp_min(1e-6)
    whole = torch.exp(-0.5 * far.square() / variance).sum()
    return torch.exp(-0.5 * (place[:, None] - place).square() / variance) / whole
