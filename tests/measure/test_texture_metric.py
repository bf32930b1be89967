"""The metric of textures: the target itself is about 1 at most, and what is wrong is far worse."""

import dataclasses
import json

import pytest
import torch
import torch.nn.functional as F

from npa_envs.cli import main
from npa_envs.errors import NPAError
from npa_envs.measure.texture_metric import TextureMetric
from npa_envs.tasks.morphogenesis2d import Morphogenesis2D, Morphogenesis2DConfig
from npa_envs.tasks.targets.textures import TextureTarget, draw_pattern
from npa_envs.tasks.texture import Texture, TextureConfig

CONFIG = TextureConfig(target="hearts", particle_count=1024, resolution=64)


@pytest.fixture(scope="module")
def task():
    return Texture(CONFIG)


@pytest.fixture(scope="module")
def metric(task):
    return TextureMetric(task)


def wrong(picture):
    """The picture [1, R, R, 4] spoiled in one way after the other."""
    side = picture.shape[1]
    order = torch.randperm(side * side, generator=torch.Generator().manual_seed(0))
    channels = picture.movedim(-1, 1)
    padded = F.pad(channels, (3, 3, 3, 3), mode="circular")
    noise = torch.randn(side, side, generator=torch.Generator().manual_seed(1))
    turned = torch.polar(torch.ones(side, side), torch.fft.fft2(noise).angle())
    return {
        "shuffled": picture.flatten(1, 2)[:, order].reshape_as(picture),
        "blurred": F.avg_pool2d(padded, 7, 1).movedim(1, -1),
        "half as large": F.avg_pool2d(channels, 2).repeat(1, 1, 2, 2).movedim(1, -1),
        "waves shifted": torch.fft.ifft2(torch.fft.fft2(channels) * turned).real.movedim(1, -1),
        "turned": picture.transpose(1, 2).flip(1),
        "other colours": picture[..., [1, 2, 0, 3]],
        "nothing": torch.zeros_like(picture),
    }


def test_the_target_itself_is_one_at_most(task, metric):
    for number in range(3):
        ratios = metric(task.drawing(number))
        assert ratios.shape == (1, 3)
        # 0.33 was the largest seen: grey noise limits what they are divided by.
        assert float(ratios.max()) < 1.1
    # Pixels as sharp as no particles are: 0.5.
    assert float(metric(task.target_picture[None]).mean()) < 2.0


def test_what_is_wrong_is_far_worse(task, metric):
    drawn = task.drawing(5)
    good = float(metric(drawn).mean())
    for kind, picture in wrong(drawn).items():
        assert float(metric(picture).mean()) > max(2.0, 20.0 * good), kind


def test_another_draw_of_scattered_things_is_near(task):
    config = dataclasses.replace(CONFIG, target="droplets")
    picture = torch.tensor(draw_pattern("droplets", 64, seed=7)).float()
    other = Texture(config, target=TextureTarget("droplets", picture, True))
    metric = TextureMetric(Texture(config))
    assert float(metric(other.drawing(0)).mean()) < 1.0
    assert float(metric(task.drawing(0)).mean()) > 4.0


def test_a_world_is_measured_alone_and_always_alike(task, metric):
    pictures = torch.cat([task.drawing(number) for number in range(2)] + [torch.rand(1, 64, 64, 4)])
    together = metric(pictures)
    assert torch.equal(together, TextureMetric(task)(pictures))
    for picture, ratios in zip(pictures, together, strict=True):
        assert torch.equal(metric(picture[None])[0], ratios)
    moved = metric(pictures.roll((9, -14), dims=(1, 2)))
    # Patches of the largest length lie apart: 0.6 was the largest difference seen.
    torch.testing.assert_close(moved, together, rtol=0.02, atol=1.0)


def test_devices_agree(task, metric, device):
    picture = task.drawing(3)
    there = TextureMetric(Texture(CONFIG, device=device))
    torch.testing.assert_close(there(picture).cpu(), metric(picture), rtol=1e-3, atol=1e-3)


def test_a_target_with_edges_is_not_read_across_them():
    half = torch.zeros(64, 64, 4)
    half[:, :, 3] = 1.0
    half[:, :32, 0] = 1.0
    ratios = {}
    for tiles in (False, True):
        task = Texture(CONFIG, target=TextureTarget("half", half, tiles))
        ratios[tiles] = TextureMetric(task)(task.drawing(0))[0]
    assert float(ratios[True].max()) < 1.0
    # Its left edge is red and its right one black: only a torus has that step twice.
    assert float(ratios[False][1]) > 3.0


def test_only_textures_are_measured(task):
    with pytest.raises(NPAError, match="texture metric compares textures, got Morphogenesis2D"):
        TextureMetric(Morphogenesis2D(Morphogenesis2DConfig(target="ring", resolution=32)))
    with pytest.raises(NPAError, match=r"pictures must have shape \[B, R, R, 4\]"):
        TextureMetric(task)(torch.zeros(1, 32, 32, 4))


def test_the_command_prints_ratios_and_writes_them(tmp_path, capsys):
    path = tmp_path / "table.json"
    asked = ["evaluate", "dots", "--judge", "--checkpoints", "2", "4", "--seed-count", "1"]
    assert main([*asked, "--particle-count", "128", "--no-progress", "--json", str(path)]) == 0
    assert "ratio worst" in capsys.readouterr().out
    rows = json.loads(path.read_text(encoding="utf-8"))["judge"]
    assert [row["step"] for row in rows] == [2, 4]
    for row in rows:
        mean = (row["shapes"] + row["contrasts"] + row["colours"]) / 3.0
        assert row["ratio"] == pytest.approx(mean)
        assert row["ratio_worst"] == row["ratio"] > 3.0


def test_a_judge_of_other_rules_is_refused_before_the_rule_is_loaded(monkeypatch, capsys):
    monkeypatch.setattr("npa_envs.rule.files.load_rule", lambda *_, **__: pytest.fail("it loads"))
    assert main(["evaluate", "digits", "--judge"]) == 2
    assert "of the task point_classification: leave out --judge" in capsys.readouterr().err
