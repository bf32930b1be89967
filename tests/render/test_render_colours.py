import numpy as np
import pytest
import torch

from npa_envs.render.colours import density_colours, oklab, ramp, srgb, state_colours


@pytest.mark.parametrize(("background", "sign"), [((1.0, 1.0, 1.0), -1), ((0.0, 0.0, 0.0), 1)])
def test_the_ramp_is_even_to_the_eye(background, sign):
    table = ramp(background)
    steps = np.diff(oklab(torch.from_numpy(table[::32] / 255)).numpy(), axis=0)
    # Of the darkest colours, 8 bits hold too few to be even.
    lengths = np.linalg.norm(steps, axis=1)[table[:-32:32].max(axis=1) > 40]
    assert len(lengths) > 20
    assert lengths.max() / lengths.min() < 1.35
    assert (sign * steps[:, 0] >= 0).all()
    assert (table[0] == np.array(background) * 255).all()


def test_density_colours_are_monotone_and_bounded():
    shown = density_colours(torch.tensor([0.0, 0.5, 1.0, 2.0, 1e30]), (1.0, 1.0, 1.0))
    lightness = oklab(torch.from_numpy(shown / 255))[:, 0]
    assert (lightness.diff() < -0.05).all()


def test_oklab_has_its_published_values_and_an_inverse():
    given = torch.tensor([[1.0, 1.0, 1.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]], dtype=torch.float64)
    published = torch.tensor(
        [[1.0, 0.0, 0.0], [0.628, 0.2249, 0.1258], [0.452, -0.0325, -0.3115]], dtype=torch.float64
    )
    torch.testing.assert_close(oklab(given), published, rtol=0, atol=1e-3)
    colours = torch.rand(50, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    torch.testing.assert_close(srgb(oklab(colours)), colours, rtol=0, atol=1e-5)


def test_blank_states_are_grey_and_states_differ_in_colour():
    grey = state_colours(torch.zeros(1, 13))[0]
    assert (grey.max() - grey.min()) < 1e-3
    assert 0.4 < grey.mean() < 0.8
    channels = oklab(state_colours(torch.eye(13) * 0.8))
    apart = torch.cdist(channels, channels) + torch.eye(13)
    assert apart.min() > 0.02
    assert (channels - oklab(grey)).norm(dim=1).min() > 0.05


def test_state_colours_are_bounded_for_any_state():
    generator = torch.Generator().manual_seed(1)
    for size in (1.0, 1e4, 1e30):
        colours = state_colours(torch.randn(200, 13, generator=generator) * size)
        assert colours.isfinite().all()
        assert (colours >= 0).all()
        assert (colours <= 1).all()
