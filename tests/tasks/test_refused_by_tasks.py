"""What tasks, targets, losses and damages reject, and what they say then."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from npa_envs.errors import NPAError
from npa_envs.measure.quality import picture_rows
from npa_envs.rule.rule import NPARule
from npa_envs.tasks.losses.texture import TEXTURE_LOSSES, make_texture_loss
from npa_envs.tasks.many_pictures import ManyPictures
from npa_envs.tasks.morphogenesis2d import Morphogenesis2DConfig
from npa_envs.tasks.morphogenesis3d import Morphogenesis3D, Morphogenesis3DConfig
from npa_envs.tasks.point_classification import PointClassification, PointClassificationConfig
from npa_envs.tasks.targets.digit_clouds import load_pictures
from npa_envs.tasks.targets.picture_points import load_target
from npa_envs.tasks.targets.textures import load_texture
from npa_envs.tasks.targets.views import load_views
from npa_envs.tasks.texture import Texture, TextureConfig
from npa_envs.world.brushes import clump, cut, wipe_state

PLANE, TEXTURE = Morphogenesis2DConfig, TextureConfig
SPACE, POINTS = Morphogenesis3DConfig, PointClassificationConfig
TURNED = {"equivariant": True}
SMALL_TEXTURE = TextureConfig(resolution=24)
NINE = NPARule(3, readout_dim=9, readout_hidden_dim=4)
DOTS, VIEWS = load_texture("dots", resolution=9), load_views("duck", resolution=9)
SMALL = Morphogenesis3DConfig(target="doughnut", resolution=16, training_views=1, held_out_views=1)
TINY = replace(SMALL, resolution=12, ssim_weight=0.2)


@pytest.mark.parametrize(
    ("cls", "fields", "message"),
    [
        (TEXTURE, {"target": ""}, "target must be a built-in texture or a path"),
        (TEXTURE, {"loss": "swd"}, "loss must be a texture loss that exists"),
        (TEXTURE, {"loss": "patch_ot+joint_sdw"}, "did you mean 'joint_swd'"),
        (TEXTURE, {"loss": "patch_ot+patch_swd"}, "summed must be joint ones.*joint_swd"),
        (TEXTURE, {"loss": ["patch_ot"]}, r"loss that exists, got \['patch_ot'\]: known"),
        (TEXTURE, {"loss_seed": -1}, "loss_seed must be a whole number"),
        (TEXTURE, {"state_dim": 2}, "state_dim must be a whole number of at least 3"),
        (TEXTURE, {"resolution": 8}, "resolution must be a whole number of at least 12"),
        (TEXTURE, {"eps": 1.2}, "box_size must be at least 2 eps"),
        (TEXTURE, {"sigma": 0.0}, "sigma must be a finite number greater than 0"),
        (TEXTURE, {"density_weight": -1.0}, "density_weight must be a finite number of at least"),
        (TEXTURE, {"vgg_weights": 3}, "vgg_weights must be a path"),
        (SPACE, {"target": ""}, "target must be a built-in mesh"),
        (SPACE, {"state_dim": 2}, "state_dim must be a whole number of at least 3"),
        (SPACE, {"resolution": 4}, "resolution must be a whole number of at least 8"),
        (SPACE, {"views_per_iteration": 0}, "views_per_iteration must be a whole"),
        (SPACE, {"opacity": 1.0}, "opacity must lie below 1"),
        (SPACE, {"opacity": 0.0}, r"opacity must lie in \(0, 1\]"),
        (SPACE, {"sigma": 0.0}, "sigma must be a finite number greater than 0"),
        (SPACE, {"blur_sigma": -1.0}, "blur_sigma must be a finite number of at least"),
        (SPACE, {"view_seed": -1}, "view_seed must be a whole number"),
        (POINTS, {"data": ""}, "data must be a name or a path"),
        (POINTS, {"stretch": 1.5}, "stretch must be at most 1"),
        (POINTS, {"rotation": -1.0}, "rotation must be a finite number of at"),
        (POINTS, {"class_count": 1}, "class_count must be a whole number of at"),
        (POINTS, {"sample_seed": -1}, "sample_seed must be a whole number"),
        (PLANE, {"equivariant": "yes"}, "equivariant must be True or False, got 'yes'"),
        (PLANE, TURNED | {"chiral": 1}, "chiral must be True or False, got 1"),
        (PLANE, TURNED | {"seed_axis": -1.0}, "seed_axis must be a finite number of at least 0"),
        (PLANE, TURNED | {"angles": -1}, "angles must be a whole number of at least 0, got -1"),
        (PLANE, TURNED | {"angles": 3}, "angles must be 0 or at least 4, got 3"),
        (PLANE, TURNED | {"angles": 0, "seed_axis": 0.0}, "angles=0 needs initial worlds"),
        (PLANE, TURNED | {"angles": 0, "chiral": False}, "=0.0 and chiral=False: set seed_across="),
        (PLANE, TURNED | {"division": True}, "division goes neither with equivariant"),
        (PLANE, {"targets": ("ring",), "division": True}, "division goes neither with equivariant"),
        (PLANE, {"targets": ["heart"]}, "targets must be a tuple"),
        (PLANE, {"targets": ("ring",), "code_dim": 0}, "code_dim must be a whole number"),
        (PLANE, {"targets": ("ring",), "switch_share": 1.5}, "switch_share must be at most 1"),
    ],
)
def test_fields_that_are_no_choice(cls, fields, message):
    with pytest.raises(NPAError, match=message):
        cls(**fields)


X, S, PLACE = torch.zeros(2, 4, 2), torch.zeros(2, 4, 3), torch.zeros(2, 2)
AT = {"centre": PLACE, "radius": 0.1}


def many(*targets, **fields):
    return ManyPictures(Morphogenesis2DConfig(targets=targets or ("heart", "ring"), **fields))


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: wipe_state(X, S[:, :3], **AT), "x and s must agree in worlds and particles"),
        (lambda: wipe_state(X, S, centre=PLACE, radius=PLACE[0, :1]), r"or a tensor of .* \[B\]"),
        (lambda: cut(X, S, centre=PLACE, normal=torch.zeros(2, 3), gap=0.1), "normal must have"),
        (lambda: clump(X, S, **AT, factor=1.5), r"factor must be in \[0, 1\], got 1\.5"),
        *(
            (lambda n=n: load_target("heart", point_count=n), "point_count must be an int")
            for n in (0, -5, 2.5, True)
        ),
        (lambda: load_target("gekco"), r"did you mean 'gecko'\?.*known: .*ring"),
        (lambda: load_target(""), "built-in name"),
        (lambda: load_target(7), "string or a Path, got int"),
        # A path is never a built-in name.
        (lambda: load_target(Path("gecko")), "does not exist"),
        (lambda: load_target(Path(__file__).parent), "is a folder"),
        (lambda: load_texture("cels"), "did you mean 'cells'.*known: bubbles, cells, dots, drop"),
        (lambda: load_texture(""), "known: bubbles, cells"),
        (lambda: load_texture("missing.png"), "does not exist"),
        (lambda: load_texture("cells", resolution=0), "resolution must be an integer of at least"),
        (lambda: load_views("rocke"), "did you mean 'rocket'"),
        (lambda: load_views("there/is/none.glb"), "does not exist"),
        (lambda: load_views(""), "target must be a built-in mesh"),
        (lambda: load_views("duck", resolution=0), "resolution must be an integer"),
        (lambda: load_pictures("digit"), "did you mean 'digits'"),
        (lambda: many("heart", "hart"), "unknown|emoji"),
        (lambda: picture_rows(NINE, [None], seeds=(1,)), "pictures must be two or more, got 1"),
        (lambda: many(equivariant=True), "targets need a rule that knows directions"),
        (lambda: Texture(SMALL_TEXTURE, target=DOTS), "target must have 24 x 24 pixels"),
        (lambda: Morphogenesis3D(SMALL, target=VIEWS), "views must have 16 x 16 pixels"),
        (lambda: Morphogenesis3D(TINY), "at least 16 pixels for MS-SSIM"),
        (lambda: Morphogenesis3D(SMALL).for_rule(NINE), "must have a read-out of 20 outputs, or"),
    ],
)
def test_damages_and_targets(call, message):
    with pytest.raises(NPAError, match=message):
        call()


@pytest.mark.parametrize(
    ("goal", "message"),
    [
        (torch.tensor([0, 3]), r"at least 0 and below 3, got \[0, 3\]: for example"),
        (torch.tensor([0, -1]), r"at least 0 and below 3, got \[0, -1\]: for example"),
        (torch.tensor([0.0]), r"int64 tensor of shape \[B\], got torch.float32 \(1,\)"),
        (torch.tensor(0), r"int64 tensor of shape \[B\], got torch.int64 \(\)"),
        ([0, 1], r"int64 tensor of shape \[B\], got \[0, 1\]"),
    ],
)
def test_classes_that_do_not_exist(folder, goal, message):
    config = PointClassificationConfig(data=str(folder), class_count=3)
    with pytest.raises(NPAError, match=f"goal must .*{message}"):
        PointClassification(config).with_goal(goal)
    task = PointClassification(replace(config, class_count=2))
    with pytest.raises(NPAError, match="more than the highest class of the data, 2, got 2"):
        task.seed(1, generator=torch.Generator())


@pytest.mark.parametrize("name", [name for name in TEXTURE_LOSSES if name != "vgg_ot"])
def test_texture_losses(name):
    channels = 4 if TEXTURE_LOSSES[name].joint else 3
    target = torch.rand(channels, 16, 16)
    loss = make_texture_loss(name, target)
    for call, message in (
        (lambda: loss(target), r"images must have shape \[B, K, R, R\]"),
        (lambda: loss(target[None, :-1]), r"images must have shape \[B, K, R, R\]"),
        (lambda: loss(target[None, :, :12, :12]), "at the target's resolution"),
        (lambda: make_texture_loss(name, target[:, :10, :10]), "resolution must be at least 12"),
        (lambda: make_texture_loss(name, target.movedim(0, 2)), r"shape \[K, R, R\]"),
        (lambda: make_texture_loss(name, np.zeros((4, 16, 16))), r"\[K, R, R\], got ndarray"),
        (lambda: make_texture_loss("vgg_ot", torch.rand(2, 32, 32)), "1 or 3 channels, got 2"),
        (lambda: make_texture_loss("vgg_ot", torch.rand(3, 24, 24)), "at least 32 pixels for vgg"),
    ):
        with pytest.raises(NPAError, match=message):
            call()
