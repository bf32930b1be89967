"""The task of 3D morphogenesis: a ball of particles with zero states grows into an object."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Self

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from npa_envs.checks import (
    check_field,
    check_fraction,
    check_non_negative,
    check_positive,
    check_seed,
    check_text,
)
from npa_envs.errors import NPAError
from npa_envs.ops import Cameras, render_gaussians
from npa_envs.ops.world_mean import scalar_world_mean
from npa_envs.rule.rule import NPARule
from npa_envs.tasks.base import GrowthConfig, GrowthTask, contributions_to_loss
from npa_envs.tasks.gaussian_outputs import OUTPUTS, Gaussians, appearance
from npa_envs.tasks.losses.ms_ssim import MultiScaleSimilarity
from npa_envs.tasks.targets.notes import tell
from npa_envs.tasks.targets.views import (
    Views,
    ViewTarget,
    composited,
    load_views,
    nearest_camera,
    some_views,
)
from npa_envs.tasks.train_config import Common, TrainConfig, fast_run, presets_of, tiny_run
from npa_envs.world.cuda_graph import to_device_async
from npa_envs.world.particles import Particles


@dataclass(frozen=True, kw_only=True)
class Morphogenesis3DConfig(GrowthConfig):
    """3D morphogenesis: a ball of particles with zero states grows into an object.

    Pictures of worlds by several cameras, the views, are compared with those of the target. The
    defaults are the paper's (arXiv 2601.16096) where these are known. Lengths are in length units:
    the target lies within 0.85 of the origin.
    """

    target: Common[str] = "mushroom"
    """What to grow: a built-in mesh, a file of a mesh, points or Gaussians, or a views folder."""

    particle_count: Common[int] = 16384
    """Particles in a world, N."""

    hidden_dim: Common[int] = 256
    """Width of the rule's hidden layer."""

    readout_hidden_dim: int = 256
    """Width of the hidden layer of the read-out, which maps states to Gaussians."""

    alpha: float = 1.0
    """Largest displacement in one step, as a fraction of ε (dimensionless)."""

    seed_radius: float = 1.0
    """Radius of the ball that the particles start in [length units]."""

    resolution: Common[int] = 192
    """Pixels on each side of a view, R."""

    training_views: int = 48
    """Maximum number of views of the target to train with."""

    held_out_views: int = 12
    """Maximum number of other views of the target, which only metrics use."""

    views_per_iteration: int = 4
    """Number of training views that the loss compares, others in each iteration."""

    view_seed: int = 0
    """Seed of the random choice of views and backgrounds for the iterations."""

    sigma: float = 0.02
    """Standard deviation of a round particle [length units]."""

    anisotropy: float = 0.1
    """Bound of |log(standard deviation / sigma)| along each axis of a particle (dimensionless)."""

    opacity: float = 0.15
    """Opacity of a particle whose read-out is 0, in (0, 1)."""

    blur_sigma: float = 20.0
    """Standard deviation of the targets' blur at the first iteration [pixels]; 0: none."""

    blur_iterations: int = 1000
    """Iterations in which the blur falls linearly to 0; in the paper a twentieth of the run."""

    view_weight: float = 2.0
    """Weight of the difference of views (dimensionless)."""

    ssim_weight: float = 0.2
    """Weight of 1 − MS-SSIM, relative to the mean absolute difference of views (dimensionless)."""

    isotropy_weight: float = 0.5
    """Weight of mean |log(standard deviation / sigma)| (dimensionless)."""

    overflow_weight: float = 10.0
    """Weight of mean |s − clip(s, −1, 1)| (dimensionless)."""

    bound_weight: float = 10.0
    """Weight of mean |x − clip(x, −1, 1)| (per length unit)."""

    def __post_init__(self) -> None:
        super().__post_init__()
        check_text(self, "target", "a built-in mesh, a mesh file or a folder of views")
        check_positive(self, int, "readout_hidden_dim", "training_views", "held_out_views")
        check_positive(self, int, "views_per_iteration", "blur_iterations")
        check_positive(self, float, "sigma")
        check_fraction(self, "opacity")
        check_non_negative(self, "anisotropy", "blur_sigma")
        check_non_negative(self, "view_weight", "ssim_weight", "isotropy_weight")
        check_field(self, "opacity", self.opacity < 1.0, "lie below 1", "for example opacity=0.99")
        check_seed(self, "view_seed", bits=31)


SHOWN_FROM = 20.0
"""Elevation [degrees] of a camera in front: pictures show the held-out view nearest to it."""

GREY = 0.5
"""Brightness of the background of views that `metric` compares, in [0, 1]."""


class Morphogenesis3D(GrowthTask[Morphogenesis3DConfig]):
    """The task of growing a 3D object of arXiv 2601.16096, with its loss.

    Each particle is drawn as a 3D Gaussian. It is round, and the last three channels of its state
    are its colour. In the task that `for_rule` returns, the rule's read-out network computes shape
    and colour from the state.
    """

    space_dim = 3
    metric_name = "view loss"
    has_views = True
    _resized_with = ("target",)
    _rule: NPARule | None = None

    def __init__(
        self,
        config: Morphogenesis3DConfig | None = None,
        *,
        target: ViewTarget | None = None,
        device: str | torch.device = "cpu",
    ) -> None:
        self.config = config = config or Morphogenesis3DConfig()
        side = config.resolution
        if target is None:
            target = load_views(
                config.target,
                resolution=side,
                training_count=config.training_views,
                held_out_count=config.held_out_views,
            )
            tell(target.summary)
        for views in (target.training, target.held_out):
            if views.pictures.shape[1:] != (side, side, 4):
                raise NPAError(
                    f"views must have {side} x {side} pixels as config.resolution says, "
                    f"got {tuple(views.pictures.shape[1:])}: load them at that size"
                )
        self.target = target.to(device)
        """The views of the target."""
        front = nearest_camera(target.held_out.cameras, SHOWN_FROM)
        self._shown = some_views(self.target.held_out, torch.tensor([front], device=device))
        # The first row of a picture is the bottom.
        self._target_picture = self._shown.pictures[0].flip(0)
        view_count = min(config.views_per_iteration, len(target.training.pictures))
        self.view_index = torch.zeros(view_count, dtype=torch.int64, device=device)
        """Indices of the training views that the loss compares in this iteration, shape [V]."""
        self.backgrounds = torch.zeros(view_count, 3, device=device)
        """Background colours of these views, in [0, 1], shape [V, 3]."""
        self.blur_sigma = torch.zeros((), device=device)
        """Standard deviation of the blur of the target's views [pixels], shape []."""
        self.begin(0)
        with_similarity = config.ssim_weight > 0.0
        self._similarity = MultiScaleSimilarity(side, device=device) if with_similarity else None

    def for_rule(self, rule: NPARule) -> Self:
        """Return a copy of the task whose pictures use a rule's read-out, if it has one."""
        if rule.readout_dim not in (0, OUTPUTS):
            raise NPAError(
                f"the rule must have a read-out of {OUTPUTS} outputs, or none, got readout_dim="
                f"{rule.readout_dim}: it was made for another task"
            )
        return self._copy_with(_rule=rule if rule.readout_dim else None)

    @property
    def rule_shape(self) -> dict[str, Any]:
        """Arguments of `NPARule` in addition to state_dim, hidden_dim and eps0."""
        readout = {"readout_dim": OUTPUTS, "readout_hidden_dim": self.config.readout_hidden_dim}
        return super().rule_shape | readout

    def begin(self, iteration: int) -> None:
        """Set the views, backgrounds and blur of an iteration, which `loss` uses from now on."""
        config = self.config
        random = np.random.default_rng((config.view_seed, iteration))
        total, count = len(self.target.training.pictures), len(self.view_index)
        index = random.choice(total, count, replace=False).astype(np.int64)
        backgrounds = random.random(self.backgrounds.shape, dtype=np.float32)
        sigma = config.blur_sigma * max(0.0, 1.0 - iteration / config.blur_iterations)
        values: tuple[NDArray[Any], ...] = index, backgrounds, np.array(sigma, dtype=np.float32)
        tensors = self.view_index, self.backgrounds, self.blur_sigma
        for tensor, value in zip(tensors, values, strict=True):
            tensor.copy_(to_device_async(value, tensor.device))

    def gaussians(self, s: Tensor) -> Gaussians:
        """Return the 3D Gaussian that draws each particle, from states s."""
        outputs = s[..., -3:] if self._rule is None else self._rule.read_out(s)
        config = self.config
        return appearance(outputs, config.sigma, config.anisotropy, config.opacity)

    def views(self, x: Tensor, s: Tensor, cameras: Cameras) -> Tensor:
        """Return pictures of worlds by V cameras, shape [B, V, H, W, 4].

        Channels are red, green and blue, each times alpha, and alpha. The first row is the top.
        """
        return self._draw(x, self.gaussians(s), cameras)

    def picture(self, x: Tensor, s: Tensor) -> Tensor:
        """Return worlds by the camera nearest `SHOWN_FROM`, [B, R, R, 4], bottom row first."""
        return self.views(x, s, self._shown.cameras)[:, 0].flip(1)

    def metric(self, x: Tensor, s: Tensor) -> Tensor:
        """Return each world's loss on the held-out views, drawn on a grey background, shape [B]."""
        return self._metric(x, self.gaussians(s))

    def view_psnr(self, x: Tensor, s: Tensor) -> Tensor:
        """Return each world's mean PSNR [dB] of held-out views on a white background, [B]."""
        held_out, white = self.target.held_out, x.new_ones(3)
        views, targets = self.views(x, s, held_out.cameras), held_out.pictures.to(x)
        error = composited(views, white).clamp(0.0, 1.0) - composited(targets, white)
        return (-10.0 * error.square().mean(dim=(2, 3, 4)).log10()).mean(dim=1)

    def particle_contributions(self, x: Tensor, s: Tensor) -> Tensor:
        """Return N times each particle's contribution to its world's `metric`, shape [B, N].

        `contributions_to_loss` computes it, with factors on particles' opacities.
        """
        with torch.enable_grad():
            gaussians = self.gaussians(s.detach())
            opacities = gaussians.opacities.detach().requires_grad_()
            loss = self._metric(x.detach(), gaussians._replace(opacities=opacities))
            (slope,) = torch.autograd.grad(loss.sum(), opacities)
        return contributions_to_loss(loss.detach(), opacities.detach() * slope)

    def compare(self, worlds: Particles) -> tuple[Tensor, dict[str, Tensor]]:
        """Return the batch's weighted loss, [], and its terms by name, []: those of `_compare` on
        the iteration's views, and "isotropy", how far particles are from round.
        """
        config, x = self.config, worlds.x
        gaussians = self.gaussians(worlds.s)
        target = some_views(self.target.training, self.view_index)
        target = Views(target.cameras, blurred(target.pictures.to(x), self.blur_sigma))
        backgrounds = self.backgrounds.to(x)[:, None, None]
        by_world = self._compare(x, gaussians, target, backgrounds)
        terms = {name: values.mean() for name, values in by_world.items()}
        terms["isotropy"] = gaussians.stretch.abs().mean()
        total = config.view_weight * self._weighted(terms)
        return total + config.isotropy_weight * terms["isotropy"], terms

    def _metric(self, x: Tensor, gaussians: Gaussians) -> Tensor:
        """Return each world's `metric`, shape [B], for particles with these looks."""
        grey = x.new_full((3,), GREY)
        return self._weighted(self._compare(x, gaussians, self.target.held_out, grey))

    def _draw(self, x: Tensor, gaussians: Gaussians, cameras: Cameras) -> Tensor:
        pictures = render_gaussians(x, *gaussians[:4], cameras.to(x))
        return torch.cat((pictures.image, pictures.alpha[..., None]), dim=-1)

    def _compare(
        self, x: Tensor, gaussians: Gaussians, target: Views, background: Tensor
    ) -> dict[str, Tensor]:
        """Return each world's distances from the target's views, shape [B] each.

        "views" is the mean |difference| of colours and alpha. "structure" is 1 − MS-SSIM, which is
        there if its weight is not 0.
        """
        drawn, pictures = (
            torch.cat((composited(views, background), views[..., 3:]), dim=-1)
            for views in (self._draw(x, gaussians, target.cameras), target.pictures.to(x))
        )
        size = (drawn - pictures).abs()
        terms = {"views": scalar_world_mean(size)}
        if self._similarity is not None:
            similarity = self._similarity(drawn.movedim(-1, 2), pictures.movedim(-1, 1))
            terms["structure"] = 1.0 - similarity.mean(dim=(1, 2))
        return terms

    def _weighted(self, terms: dict[str, Tensor]) -> Tensor:
        """Return the weighted sum of the terms of `_compare`."""
        if "structure" not in terms:
            return terms["views"]
        return terms["views"] + self.config.ssim_weight * terms["structure"]


def blurred(pictures: Tensor, sigma: Tensor) -> Tensor:
    """Return pictures [V, H, W, K] blurred by a Gaussian, as if they were 0 outside of their edges.

    `sigma` is its standard deviation [pixels], a tensor of shape [] that is not read back from the
    device. A `sigma` of 0 leaves pictures unchanged, bit for bit.
    """
    rows, columns = (_blur_matrix(size, sigma, pictures) for size in pictures.shape[1:3])
    across = torch.einsum("xw,vhwk->vhxk", columns, pictures)
    return torch.einsum("yh,vhxk->vyxk", rows, across)


def _blur_matrix(size: int, sigma: Tensor, like: Tensor) -> Tensor:
    """Return the matrix [size, size] that blurs a row of `size` pixels, in dtype of `like`."""
    far = torch.arange(-size, size + 1, device=like.device, dtype=like.dtype)
    pixel = far[size : 2 * size]
    variance = sigma.to(like).square().clamp_min(1e-6)
    whole = torch.exp(-0.5 * far.square() / variance).sum()
    return torch.exp(-0.5 * (pixel[:, None] - pixel).square() / variance) / whole


_STRETCHED: Mapping[str, Any] = {
    "anisotropy": 1.0, "isotropy_weight": 0.02, "escape_weight": 10.0, "clump_radius": 0.2,
    "cut_gap": 0.1,
}  # fmt: skip
"""Settings of the task for stretched particles, stable worlds, and healing of clumps and cuts."""

MORPHOGENESIS3D_PRESETS = presets_of(
    "morphogenesis3d",
    paper=TrainConfig(
        task=Morphogenesis3DConfig(), iterations=20_000, repeats=1, world_count=4, pool_size=16,
        steps=(16, 32), learning_rate=1e-3, milestones=(2_000, 10_000), seed_interval=1,
    ),
    # Half as many particles, which see as many neighbours; half of a batch are initial worlds:
    # docs/morphogenesis3d.md.
    best=TrainConfig(
        task=Morphogenesis3DConfig(
            particle_count=8192, state_dim=24, eps=0.126, seed_radius=0.7, views_per_iteration=8,
            sigma=0.014, opacity=0.6, blur_sigma=0.0, damage_radius=0.15, escape_share=5e-5,
            **_STRETCHED,
        ),
        iterations=9000, repeats=1, world_count=4, pool_size=32, steps=(30, 34), optimiser="muon",
        learning_rate=5e-3, weight_decay=0.1, schedule="cosine", seed_interval=1, fresh_share=0.5,
        damage_share=0.25, initial_rule="rocket-8192",
    ),
    # Of two worlds one is young, one grown and at rest, so that what has grown stays:
    # docs/morphogenesis3d.md.
    fast=fast_run(
        task=Morphogenesis3DConfig(
            particle_count=768, hidden_dim=64, readout_hidden_dim=32, eps=0.3, alpha=0.3,
            seed_radius=0.6, resolution=40, training_views=32, held_out_views=8,
            views_per_iteration=3, sigma=0.06, opacity=0.5, blur_sigma=4.0, blur_iterations=100,
            escape_share=1e-3, **_STRETCHED,
        ),
        iterations=2000, pool_size=32, steps=(10, 20), optimiser="muon", learning_rate=5e-3,
        schedule="cosine", max_age_range=(16, 256), damage_share=0.5, stillness_min_age=48,
        stillness_weight=0.5, picture_interval=100,
    ),
    tiny=tiny_run(
        task=Morphogenesis3DConfig(
            target="doughnut", particle_count=200, hidden_dim=32, readout_hidden_dim=16, eps=0.4,
            seed_radius=0.6, resolution=32, training_views=8, held_out_views=4,
            views_per_iteration=2, sigma=0.08, opacity=0.6, blur_sigma=3.0, blur_iterations=5,
            ssim_weight=0.0,
        ),
        pool_size=4, steps=(6, 10), seed_interval=1,
    ),
)  # fmt: skip
"""`paper` (arXiv 2601.16096), `best` (any mesh, one run of minutes on a GPU), `fast` (on one core),
`tiny` (tests)."""
