"""From splatted fields to pictures for the eye."""

from __future__ import annotations

import numpy as np
import torch
from numpy.typing import NDArray
from PIL import ImageColor
from torch import Tensor

from npa_envs.errors import NPAError
from npa_envs.ops.checks import check_dense, checked_number, entries

Background = str | tuple[float, float, float]


def to_uint8(picture: Tensor, background: Background = "white") -> NDArray[np.uint8]:
    """Show splatted colours over a background, with y upwards.

    Where particles overlap, so that the density is above 1, their colours are averaged; where it is
    below 1, the background shines through. What is not finite is shown as background.

    Args:
        picture: Sums of red, green and blue and the density (dimensionless), shape [..., R, R, 4],
            on any device; its first row is the lowest y, as `splat` makes it.
        background: A colour name such as "black", "#rrggbb", or red, green and blue in [0, 1].

    Returns:
        Pixels of shape [..., R, R, 3]; the first row is the highest y.

    Raises:
        NPAError: A wrong shape or dtype, or an unknown colour.
    """
    if not isinstance(picture, Tensor):
        raise NPAError(
            f"picture must be a torch tensor, got {type(picture).__name__}: give what splat returns"
        )
    if picture.ndim < 3 or picture.shape[-1] != 4 or not picture.is_floating_point():
        raise NPAError(
            "picture must be a floating tensor of shape [..., R, R, 4] (colour sums, density), "
            f"got {picture.dtype} {tuple(picture.shape)}: give what splat returns"
        )
    check_dense("picture", picture)
    behind = background_colour(background)
    fields = picture.detach().float()
    valid = fields.isfinite().all(dim=-1, keepdim=True)
    fields = torch.where(valid, fields, torch.zeros_like(fields))
    sums, density = fields[..., :3], fields[..., 3:]
    # Added channel by channel: a tensor of the colour would be a copy to the device for each frame.
    shown = sums / density.clamp(min=1)
    uncovered = 1 - density.clamp(0, 1)
    shown = torch.stack([shown[..., k] + uncovered[..., 0] * behind[k] for k in range(3)], dim=-1)
    pixels = (shown.clamp(0, 1) * 255).round().to(torch.uint8).flip(-3)
    return pixels.cpu().numpy()


def background_colour(background: Background) -> tuple[float, float, float]:
    """Return red, green and blue in [0, 1] of a colour name, "#rrggbb" or a triple.

    Args:
        background: The colour.

    Raises:
        NPAError: The name is unknown, or the triple is not three numbers in [0, 1].
    """
    if isinstance(background, str):
        try:
            red, green, blue = ImageColor.getrgb(background)[:3]
        except ValueError as error:
            raise NPAError(
                f"background must be a colour, got {background!r}: "
                "give 'white', 'black', another name of CSS, or '#rrggbb'"
            ) from error
        return red / 255, green / 255, blue / 255
    given = entries(background)
    channels = [checked_number("a channel of background", part) for part in given or ()]
    if len(channels) != 3 or not all(0 <= channel <= 1 for channel in channels):
        raise NPAError(
            f"background must be red, green and blue in [0, 1], got {background!r}: "
            "for white give (1, 1, 1)"
        )
    return channels[0], channels[1], channels[2]
