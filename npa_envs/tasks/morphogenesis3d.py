"""3D morphogenesis: a ball of blank particles grows into a thing seen from all sides."""

from __future__ import annotations

import copy

import torch
from torch import Tensor

from npa_envs.errors import NPAError
from npa_envs.ops import Cameras, world_mean
from npa_envs.rule.rule import NPARule
from npa_envs.tasks.appearance import OUTPUTS, Appearance, Gaussians
from npa_envs.tasks.morphogenesis3d_config import Morphogenesis3DConfig
from npa_envs.tasks.pool_damage import hurt
from npa_envs.tasks.renderers import RENDERERS
from npa_envs.tasks.rules import untrained_rule
from npa_envs.tasks.seeds import uniform_ball
from npa_envs.tasks.strays import stray_motion
from npa_envs.tasks.structure import MultiScaleSimilarity
from npa_envs.tasks.view_schedule import ViewSchedule, blurred
from npa_envs.tasks.views import ViewTarget, load_views, nearest_elevation, over, some_views
from npa_envs.world.randomness import Randomness

SHOWN_FROM = 20.0
"""Pictures show the held-out view whose elevation is nearest to this [degrees]."""

GREY = 0.5
"""Background of the views that `metric` compares."""


class Morphogenesis3D:
    """The task of arXiv 2601.16096 with its loss; satisfies `PictureTask`, `ReadOutTask`.

    As it is, the last three channels of a state are its colour and particles are round; `for_rule`
    gives the task that sees what a rule reads out of the states.

    Args:
        config: Target, world, rule size and loss.
        target: The target, where it is at hand already; by default `config.target` is loaded.
        device: Where views are kept and worlds are compared with them.

    Raises:
        NPAError: The target cannot be loaded, or its views have another size.
        MissingDependencyError: A library that the configuration asks for is not installed.
    """

    def __init__(
        self,
        config: Morphogenesis3DConfig | None = None,
        *,
        target: ViewTarget | None = None,
        device: str | torch.device = "cpu",
    ) -> None:
        self.config = config = config or Morphogenesis3DConfig()
        side = config.resolution
        self._similarity = None
        if config.ssim_weight > 0.0:
            self._similarity = MultiScaleSimilarity(side, 4, device=device)
        if target is None:
            target = load_views(
                config.target,
                resolution=side,
                training_count=config.training_views,
                held_out_count=config.held_out_views,
            )
        for views in (target.training, target.held_out):
            if views.pictures.shape[1:] != (side, side, 4):
                raise NPAError(
                    f"views must have {side} x {side} pixels as config.resolution says, "
                    f"got {tuple(views.pictures.shape[1:])}: load them at that size"
                )
        shown = nearest_elevation(target.held_out.cameras, SHOWN_FROM)
        self.target = target.to(device)
        """What worlds are to look like."""
        self._shown = some_views(self.target.held_out, torch.tensor([shown], device=device))
        self.target_picture = self._shown.pictures[0].flip(0)
        """The view that pictures show: red, green and blue times alpha, and alpha, dimensionless,
        shape [R, R, 4]; rows point up."""
        self._appearance = Appearance(config.sigma, config.anisotropy, config.opacity)
        self._schedule = ViewSchedule(
            len(target.training.pictures),
            config.views_per_iteration,
            seed=config.view_seed,
            blur_sigma=config.blur_sigma,
            blur_iterations=config.blur_iterations,
            device=device,
        )
        self._rule: NPARule | None = None

    @property
    def eps(self) -> float:
        """Perception radius [length units]."""
        return self.config.eps

    @property
    def box(self) -> None:
        """Open space."""
        return None

    @property
    def update_prob(self) -> float:
        """Probability of a particle's update in a step, dimensionless."""
        return self.config.update_prob

    @property
    def metric_name(self) -> str:
        """The loss of held-out views."""
        return "view loss"

    @property
    def aligned(self) -> bool:
        """Views are compared pixel by pixel."""
        return True

    def for_rule(self, rule: NPARule) -> Morphogenesis3D:
        """Return the task that sees what a rule reads out of the states; all else is shared.

        Args:
            rule: The rule, where the worlds are.

        Raises:
            NPAError: The rule reads out something else than Gaussians.
        """
        if rule.readout_dim not in (0, OUTPUTS):
            raise NPAError(
                f"the rule must read out {OUTPUTS} numbers of a state, or none, got readout_dim="
                f"{rule.readout_dim}: it was made for another task"
            )
        seen = copy.copy(self)
        seen._rule = rule if rule.readout_dim else None
        return seen

    def make_rule(self, generator: torch.Generator) -> NPARule:
        """Return an untrained rule on the CPU; its weights are drawn from `generator`."""
        config = self.config
        return untrained_rule(
            generator,
            state_dim=config.state_dim,
            hidden_dim=config.hidden_dim,
            eps0=config.eps,
            alpha=config.alpha,
            space_dim=3,
            readout_dim=OUTPUTS,
            readout_hidden_dim=config.readout_hidden_dim,
        )

    def begin(self, iteration: int) -> None:
        """Choose the views, backgrounds and blur that `loss` sees from now on.

        Args:
            iteration: Iterations done so far in the run.
        """
        self._schedule.begin(iteration)

    def seed(
        self, world_count: int, *, generator: Randomness, device: str | torch.device = "cpu"
    ) -> tuple[Tensor, Tensor]:
        """Return fresh worlds: particles uniform in a ball around the origin, all states zero.

        Args:
            world_count: Worlds B.
            generator: Source of the positions, on `device`.
            device: Where the worlds are made.

        Returns:
            Positions [length units], shape [B, N, 3]; states, dimensionless, shape [B, N, C].
        """
        count, radius = self.config.particle_count, self.config.seed_radius
        x = uniform_ball(world_count, count, 3, radius, generator=generator, device=device)
        return x, x.new_zeros(world_count, count, self.config.state_dim)

    def damage(self, x: Tensor, s: Tensor, generator: Randomness) -> tuple[Tensor, Tensor]:
        """Return the worlds with states in a ball erased, and some particles thrown out."""
        return hurt(x, s, self.config, generator=generator)

    def gaussians(self, s: Tensor) -> Gaussians:
        """Return how particles look.

        Args:
            s: States, dimensionless, shape [B, N, C].
        """
        outputs = s[..., -3:] if self._rule is None else self._rule.read_out(s)
        return self._appearance.gaussians(outputs)

    def views(self, x: Tensor, s: Tensor, cameras: Cameras) -> Tensor:
        """Return what cameras see: colours times alpha, and alpha, shape [B, V, H, W, 4].

        Args:
            x: Positions [length units], shape [B, N, 3].
            s: States, dimensionless, shape [B, N, C].
            cameras: V cameras; the first row of what they see is the upper one.
        """
        return self._draw(x, self.gaussians(s), cameras)

    def picture(self, x: Tensor, s: Tensor) -> Tensor:
        """Return one view of each world as pictures are: rows point up, shape [B, R, R, 4]."""
        return self.views(x, s, self._shown.cameras)[:, 0].flip(1)

    def metric(self, x: Tensor, s: Tensor) -> Tensor:
        """Return each world's loss of the held-out views over grey, shape [B]."""
        return self._metric(x, self.gaussians(s))

    def view_psnr(self, x: Tensor, s: Tensor) -> Tensor:
        """Return the PSNR of colours over white, mean of the held-out views [dB], shape [B]."""
        held_out, white = self.target.held_out, x.new_ones(3)
        found, wanted = self.views(x, s, held_out.cameras), held_out.pictures.to(x)
        error = over(found, white).clamp(0.0, 1.0) - over(wanted, white)
        return (-10.0 * error.square().mean(dim=(2, 3, 4)).log10()).mean(dim=1)

    def particle_shares(self, x: Tensor, s: Tensor) -> Tensor:
        """Return each particle's share of its world's view loss, times N; [B, N].

        To first order, the loss changes by some amount with a particle's opacity. Its share is the
        loss plus N times the amount by which it does worse there than the mean of all; so the mean
        of the shares is `metric`, up to rounding.

        Args:
            x: Positions [length units], shape [B, N, 3].
            s: States, dimensionless, shape [B, N, C].
        """
        with torch.enable_grad():
            gaussians = self.gaussians(s.detach())
            opacities = gaussians.opacities.detach().requires_grad_()
            loss = self._metric(x.detach(), gaussians._replace(opacities=opacities))
            (slope,) = torch.autograd.grad(loss.sum(), opacities)
        amounts = (opacities.detach() * slope)[..., None]
        worse = amounts - world_mean(amounts)[:, None]
        return loss.detach()[:, None] + x.shape[1] * worse[..., 0]

    def loss(self, x: Tensor, s: Tensor, path_length: Tensor) -> tuple[Tensor, dict[str, Tensor]]:
        """Return the training loss and its named parts, unweighted.

        Args:
            x: Positions [length units], shape [B, N, 3].
            s: States, dimensionless, shape [B, N, C].
            path_length: How far each particle travelled in the rollout [length units], [B, N].

        Raises:
            NPAError: The shapes do not fit each other.
        """
        if path_length.shape != x.shape[:2]:
            raise NPAError(
                f"path_length must have shape {tuple(x.shape[:2])}, got {tuple(path_length.shape)}"
            )
        config, schedule = self.config, self._schedule
        gaussians = self.gaussians(s)
        chosen = some_views(self.target.training, schedule.index)
        wanted = blurred(chosen.pictures.to(x), schedule.sigma)
        backgrounds = schedule.backgrounds.to(x)[:, None, None]
        found = self._draw(x, gaussians, chosen.cameras)
        parts = {k: v.mean() for k, v in self._compare(found, wanted, backgrounds).items()} | {
            "isotropy": gaussians.stretch.abs().mean(),
            "motion": path_length.mean(),
            "overflow": (s - s.clamp(-1.0, 1.0)).abs().mean(),
            "bound": (x - x.clamp(-1.0, 1.0)).abs().mean(),
        }
        total = (
            config.view_weight * self._weighted(parts)
            + config.isotropy_weight * parts["isotropy"]
            + config.motion_weight * parts["motion"]
            + config.overflow_weight * parts["overflow"]
            + config.bound_weight * parts["bound"]
        )
        if config.stray_weight > 0.0:
            parts["stray"] = stray_motion(x, path_length)
            total = total + config.stray_weight * parts["stray"]
        return total, parts

    def _metric(self, x: Tensor, gaussians: Gaussians) -> Tensor:
        held_out = self.target.held_out
        found = self._draw(x, gaussians, held_out.cameras)
        wanted = held_out.pictures.to(x)
        return self._weighted(self._compare(found, wanted, x.new_full((3,), GREY)))

    def _draw(self, x: Tensor, gaussians: Gaussians, cameras: Cameras) -> Tensor:
        image, alpha = RENDERERS[self.config.renderer](x, gaussians, cameras.to(x))
        return torch.cat((image, alpha[..., None]), dim=-1)

    def _compare(self, found: Tensor, wanted: Tensor, background: Tensor) -> dict[str, Tensor]:
        """Return each world's mean |difference| of colours and alpha, and 1 − MS-SSIM, [B] each."""
        found, wanted = (
            torch.cat((over(views, background), views[..., 3:]), dim=-1)
            for views in (found, wanted)
        )
        size = (found - wanted).abs()
        compared = {"views": world_mean(size.flatten(1)[..., None])[:, 0]}
        if self._similarity is not None:
            goal = wanted.expand_as(found)
            alike = self._similarity(
                *(views.flatten(0, 1).movedim(-1, 1) for views in (found, goal))
            )
            compared["structure"] = 1.0 - alike.view(found.shape[:2]).mean(dim=1)
        return compared

    def _weighted(self, parts: dict[str, Tensor]) -> Tensor:
        total = parts["views"]
        if "structure" in parts:
            total = total + self.config.ssim_weight * parts["structure"]
        return total
